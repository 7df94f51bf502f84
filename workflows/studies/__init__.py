"""How accurate, stable and uncertain are the results of a recipe?

Studies of a recipe, each with a page, a table and pictures, and the code that all studies share.
Each kind of study has its own package, which imports no other kind.
Offers: `run_study.study_recipe`, `run_study.count_failures`, `cold_run.cold`.
"""
