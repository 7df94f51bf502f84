"""Which recipe did the user write, and which values in it are mistakes?

From the name or file of a recipe to a graph that is checked: parameters, steps, wires, seed and tolerance.
Nothing here runs a step or asks the cache for a result.
Offers: `loading.load`, `loading.recipes`, `changed_recipe.changed`, `json_schema.schema`,
`step_declarations.all_nodes`.
"""
