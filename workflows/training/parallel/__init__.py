"""How do several processes share the work of one training?

The mesh of processes, the bands and pictures of each process, and the messages between processes.
Nothing here depends on the mask or network that is trained.
Offers: `process_mesh.Mesh`, `process_mesh.joined`, `shared_graph.Shared`.
"""
