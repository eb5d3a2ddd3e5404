"""How far outcomes follow the context that vehicles are given."""
