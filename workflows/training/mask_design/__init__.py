"""How is a mask designed without pictures?

Terms of the mask alone, optimizers over its height map, and the page of what came out.
No network and no photograph belongs here.
Offers: `design_run.design`, `design_terms.Terms`, `optimizers.learn`.
"""
