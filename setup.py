"""Only the list of packages; everything else is in pyproject.toml."""

from setuptools import find_packages, setup

setup(
    packages=[
        *find_packages(include=["ddco_pyro", "ddco_pyro.*"]),
        "ddco_tasks",
        *(f"ddco_tasks.{name}" for name in find_packages("tasks")),
    ]
)
