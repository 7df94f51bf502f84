"""Which values do the files of a recipe and the arguments give together?

YAML with the location of every value, groups and their composition, overrides and references.
Nothing here knows what a node is.
Offers: `composition.compose`, `yaml_values.read`, `overrides.read_override`, `references.References`.
"""
