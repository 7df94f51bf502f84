"""Where does the mask of a recipe give a better picture than a filter or a smaller stop of equal
protection?

The page, the table and the pictures of the comparison, with a paragraph to quote.
Offers: `protection_study.study`, `protection_study.quotable`.
"""
