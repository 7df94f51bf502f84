"""How accurate, stable and certain are the numbers of a recipe?

Studies of a recipe, each with a page, a table and pictures, and what they share.
A kind of study has its own room, which imports no other kind.
Offers: `run_study.study_recipe`, `run_study.count_failures`, `cold_run.cold`.
"""
