"""Checkpoints of other projects: a module for each format. `any_format` chooses the one that a source needs."""
