"""Pure-torch world model: vehicles, road map, observation, events, reward, scenarios, environment."""
