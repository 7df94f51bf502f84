"""How do the pages of the guide become a handbook with pictures, search and a reference?

The text of a page stands in `recipes/guide`, and this room names none of them. What commands and
nodes say of themselves comes from `cli`.
Offers: `site_build.build_handbook`, `site_build.read_pages`,
        `recipe_and_python_reference.python_page`.
"""
