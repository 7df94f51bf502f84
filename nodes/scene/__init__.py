"""Scenes: where light enters a recipe."""
