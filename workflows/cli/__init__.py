"""What does the command `neusee` accept and print, and how does it exit?

Commands and options, their messages, and the exit codes.
Nothing here computes: a command calls the room that does. This room alone imports typer and ends the program.
Offers: `app.app`, `app.main`, `command_frame.fail`, `sweep_output.run_sweep`.
"""
