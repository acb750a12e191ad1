"""Cameras and rotations: pure jax.numpy, knowing nothing of robots, models or simulators."""
