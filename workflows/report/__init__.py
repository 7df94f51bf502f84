"""How is a result shown?

Pages, pictures, tables, exported files, what a notebook shows and what the console prints.
Nothing here decides what is computed, beyond the steps that a page reads.
Offers: `run_folder.new_run`, `run_page.document`, `run_pictures.pictures`, `data_exports.exports`, `study_page.page`,
`console.screen`, `contents.wanted`.
"""
