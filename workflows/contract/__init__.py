"""Does a node obey the rules for nodes: documents, types, reference, gradient, bounds, key and
surroundings?

The nodes of neusee pass the same rules in the tests.
Nothing here reads a recipe or a cache.
Offers: `node_contract.check_node`, `node_contract.check_all`, `surroundings.elsewhere`,
        `node_rules.Finding`.
"""
