"""Formats of other projects that a run is written in."""
