"""The plumbing: read a recipe, order its steps, find, place and run them, and say what happened."""
