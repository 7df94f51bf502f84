"""Which steps fail or lose accuracy in extreme cases?

The result and the gradient of each step in extreme cases, compared with float64.
Other studies have their own packages.
Offers: `stability_study.study`.
"""
