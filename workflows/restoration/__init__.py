"""Which scene was in front of a camera, given a frame that somebody took and the recipe of the
camera?

A frame becomes a recipe: the lens, mask and sensor of the camera, with `camera: frame` in place of
scene and laser. The engine runs this recipe as any other. No formula and no restoration belongs
here: these are nodes.
Offers: `frame_recipes.named_frames`, `frame_recipes.recipes_of`.
"""
