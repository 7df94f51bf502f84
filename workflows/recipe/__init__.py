"""Which recipe did the user write, and which values in it are mistakes?

The reading of a recipe by name or file, the check of its parameters, steps, wires, seed and
tolerance, and the draws of its uncertain values. Nothing here runs a step or looks up a result in
the cache.
Offers: `loading.load`, `loading.recipes`, `loading.changed`, `node_families.all_nodes`,
        `uncertain_inputs.Inputs`.
"""
