"""How are the figures of a run report drawn?

Each picture is drawn by one function from values to a figure. All pictures share one style.
Nothing here reads the cache; a formula of physics belongs to a node.
Offers: `style.drawn`, `style.canvas`, `camera_pictures.overview`, `optics.psf`,
        `graph_and_timeline.graph`, `graph_and_timeline.timeline`.
"""
