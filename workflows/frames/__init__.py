"""Which light levels do the files of a folder hold, and what do they lack?

Frames are found by their names, by their headers, or by a table, and all mistakes are reported
together.
Offers: `frame_folder.find_levels`, `folder_recipe.recipe_of_folder`, `sensor_group.sensor_text`.
"""
