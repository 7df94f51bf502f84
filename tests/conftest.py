import os

from hypothesis import settings

# Most of what is tested is over before a second thread is awake, and where others compute, threads that wait for each
# other take many times as long. Before torch is imported; processes that a test starts inherit it. Tests of several
# threads ask for them.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# The same cases at every run: what fails is the fault of what was changed. `pytest --hypothesis-profile=search` draws
# others.
settings.register_profile("same", derandomize=True)
settings.register_profile("search", derandomize=False)
settings.load_profile("same")
