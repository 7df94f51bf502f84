"""How does a stopped training continue with bit-identical results?

The loop of every training, and its files: the state, the table of losses, and the trained weights.
Nothing here depends on a certain network or recipe.
Offers: `resumable_loop.ResumableLoop`, `resumable_loop.NotFinite`, `resumable_loop.StateFile`.
"""
