"""How far simulated traffic is from recorded traffic that started alike."""
