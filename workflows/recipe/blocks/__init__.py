"""Which settings do the blocks `train`, `train.mask` and `train_lift` of a recipe have?

The settings of training and of the design of a mask, which are read and checked with their locations.
Nothing here trains a network or a mask.
Offers: `train_block.Training`, `train_lift_block.LiftTraining`, `mask_design_block.MaskTraining`.
"""
