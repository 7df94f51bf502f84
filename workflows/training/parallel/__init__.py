"""How do several processes train together?

Groups of processes, the bands and pictures that each takes, and what they exchange.
Nothing here knows what is trained.
Offers: `process_mesh.Mesh`, `process_mesh.joined`, `shared_graph.Shared`.
"""
