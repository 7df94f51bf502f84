"""On which device does each step run, and when?

Schedules of tasks on devices from times, sizes and memory that are given as numbers.
Nothing here runs, measures or knows what a step computes.
Offers: `heft_schedule.heft`, `tasks_and_devices.Schedule`, `machine_file.read_machines`.
"""
