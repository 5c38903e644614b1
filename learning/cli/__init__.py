"""The commands of learning: train, evaluate, inspect and sweep."""
