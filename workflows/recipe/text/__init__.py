"""Which values does a recipe have after its files and the arguments are combined?

YAML with the location of every value, groups and their composition, overrides and references.
Nothing here knows what a node is.
Offers: `composition.compose`, `yaml_values.read`, `overrides.read_override`,
        `references.References`.
"""
