"""The shipped freeway networks: what they are, made, measured and shown."""
