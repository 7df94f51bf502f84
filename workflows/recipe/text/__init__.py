"""What do the files and the arguments say together?

YAML with the place of every value, groups and their composition, overrides and references.
Nothing here knows what a node is.
Offers: `composition.compose`, `yaml_values.read`, `overrides.read_override`, `references.References`.
"""
