"""When is the earlier answer of a command still right, and how does the command give it again
without torch?

An answer is the text of a command with the files of its folder. Everything that decided the answer
is compared first; in doubt there is no answer, and the command runs as ever. Nothing but the
standard library and xxhash is imported.
Offers: `repeated_command.Command`, `stored_answer.read_answer`, `stored_answer.sweep`.
"""
