"""Look at data before training on it: tables on the terminal, and one HTML page."""
