"""Other projects' checkpoints, as parameters of `dsvla_jax.model`. On the command line: python -m dsvla_jax.weights"""
