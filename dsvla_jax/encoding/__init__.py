"""From an observation and language to what the network eats, and from its answer back to an action.

There is one path from an Observation to ModelInputs, in ``encode``; training, evaluation and serving all use it.
"""
