"""Where the episodes of a training begin: reset distributions by name (thesis chapters 3, 5)."""
