"""What does each picture of a run show?

One function a picture, from values to a figure, and the style that all share.
Nothing here reads the cache; a formula of physics belongs to a node.
Offers: `style.drawn`, `style.canvas`, `camera_overview.overview`, `optics.psf`, `recipe_graph.graph`,
`gantt.timeline`.
"""
