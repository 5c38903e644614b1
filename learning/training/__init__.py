"""Training: a configuration and a folder become a policy, and what a run writes on the way."""
