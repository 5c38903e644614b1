"""Real servo hands as plants for dexctl's controllers."""
