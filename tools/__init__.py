"""Scripts that make the shipped networks, scenarios and results anew; run from the root of the clone."""
