"""What are the numbers of a recipe worth?

Studies of a recipe, each with a page, a table and pictures, and what they share.
A kind of study has its own room, which imports no other kind.
Offers: `run_study.made`, `run_study.failed`, `cold_run.cold`.
"""
