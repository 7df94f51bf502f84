"""How does a stopped training continue and reach the same bits?

The loop of every training, and its files: the state, the table of losses, what was learnt.
Nothing here knows a network or a recipe.
Offers: `resumable_loop.ResumableLoop`, `resumable_loop.NotFinite`, `checkpoint.StateFile`.
"""
