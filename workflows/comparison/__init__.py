"""What differs between two runs: numbers, pictures, recipe, code and environment?

The folders of two runs are read and compared; no step is computed and no result store is needed.
Nothing here prints: `cli` prints the tables.
Offers: `run_record.read_record`, `comparison_report.compare`,
        `comparison_report.write_comparison`, `comparison_report.lines`.
"""
