"""How accurate, stable and uncertain are the results of a recipe, and does a mask beat a filter?

Six kinds of studies of a recipe, each with a page, a table and pictures, and the code that all
share. A kind of study imports nothing of another kind: each begins with `<kind>_study.study`.
Offers: `run_study.study_recipe`, `run_study.count_failures`, `run_study.cold`.
"""
