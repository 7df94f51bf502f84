"""Which inputs, parameters and code determine the cache key of a result?

Cache keys of results, and digests of the code of nodes and of the program itself.
Nothing here reads or writes a result, and no key depends on the content of a tensor.
Offers: `cache_key.key_of`, `cache_key.digest`, `code_digest.Code`, `code_digest.engine`.
"""
