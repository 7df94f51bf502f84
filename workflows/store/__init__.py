"""Which results are stored and where, are their files undamaged, and which results are removed
first?

The folder of results by key, with files, checksums, leases and a size budget, its copy at a URL,
and derived files. Nothing here depends on recipes or decides which results are computed.
Offers: `result_store.Store`, `remote_store.open_store`, `derived_files.DerivedFiles`,
        `serialization.each_tensor`, `result_store.compute_once`.
"""
