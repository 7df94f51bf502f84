"""How is a mask designed without training pictures?

Loss terms that depend on the mask alone, two optimisers of its height map, and the page of the
result. No network and no photograph belongs here.
Offers: `design_run.design`, `design_terms.Terms`, `mask_optimisers.descend`,
        `mask_optimisers.evolve`.
"""
