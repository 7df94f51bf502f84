"""What did a step reach that its key does not know?

A step of the user runs in a thread whose system calls are watched, beside an audit hook and the
states of chance. Nothing here knows of keys, steps or the store, or decides what becomes of a
result.
Offers: `observed_call.observed`, `observed_call.observed_import`, `taints.Covered`,
        `taints.Taint`, `kernel_layer.missing`.
"""
