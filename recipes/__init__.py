"""Recipes: cameras, scenes and studies, as YAML. No code."""
