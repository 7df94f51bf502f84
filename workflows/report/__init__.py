"""How is the result of a run, a study or a training shown?

Pages, pictures, tables, exported files, what a notebook shows and what the console prints.
Nothing here decides what is computed, beyond the steps that a page reads.
Offers: `run_folder.new_run`, `run_page.document`, `run_pictures.pictures`, `data_exports.exports`,
        `study_report.page`, `study_report.StudyRun`, `study_report.StudyReport`,
        `console.ProgressTable`, `notebook.result_html`.
"""
