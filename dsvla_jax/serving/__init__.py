"""A policy behind a websocket, for robots. `messages` and `client` need NumPy, msgpack and websockets only."""
