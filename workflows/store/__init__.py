"""Which results are stored, where, are the files undamaged, and which results are removed first?

The folder of results by key: files, checksums, leases, the budget, other machines, and what is derived from results.
Nothing here knows of recipes or decides what is computed.
Offers: `result_store.Store`, `remote_store.open_store`, `derived_files.DerivedFiles`, `serialization.each_tensor`,
`memo.compute_once`.
"""
