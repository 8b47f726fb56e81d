"""Brief studies, and what a runner reports of them."""

from legacy.pipeline.runners.study_process import Task

PROGRAM = "tests.pipeline.runners.brief_study"


def tasks(folder, plans):
    """Write a study file for each plan (text of TOML, by name) and return the tasks."""
    out = folder / "out"
    out.mkdir(exist_ok=True)
    made = []
    for name, plan in plans.items():
        (folder / f"{name}.toml").write_text(plan)
        made.append(Task(name, folder / f"{name}.toml", out / name, program=PROGRAM))
    return made


class Report:
    """What was told and how tasks ended, by name."""

    def __init__(self):
        self.ends, self.lines = {}, []

    def ended(self, name, end):
        assert name not in self.ends
        self.ends[name] = end

    def tell(self, name, line):
        self.lines.append((name, line))


def results(folder):
    return {path.parent.name: path.read_bytes() for path in sorted((folder / "out").glob("*/result.txt"))}
