"""What decides the result of a step?

Keys of the cache, from parameters, inputs and files, and digests of the code of nodes and of the program itself.
Nothing here reads or writes a result, and no tensor is read to make a key.
Offers: `cache_key.key_of`, `cache_key.digest`, `code_digest.Code`, `engine_digest.engine`.
"""
