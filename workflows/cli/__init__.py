"""What does the command `neusee` accept and print, and how does it exit?

Commands and options, their messages, and the exit codes.
Nothing here computes: a command calls the package that does. Only this package imports typer and
ends the program.
Offers: `app.app`, `app.main`, `command_frame.fail`, `sweep_screen.run_sweep`.
"""
