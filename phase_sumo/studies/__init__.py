"""Many runs: comparisons, searches, rollouts of recorded traffic, measurements of speed."""
