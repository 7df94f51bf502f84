"""Which settings do the blocks `train`, `train.mask` and `train_lift` of a recipe have?

The settings of training, of the design of a mask and of an evaluation, which are read and checked
with their locations. Nothing here trains a network or a mask.
Offers: `train_block.Training`, `train_block.LiftTraining`, `train_block.MaskTraining`,
        `settings_block.EvaluateSettings`.
"""
