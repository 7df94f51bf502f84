"""The loop that every training runs, and the files from which a stopped training goes on."""
