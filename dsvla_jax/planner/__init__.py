"""Ahead-of-time plans of training and decoding on slices that are not there."""
