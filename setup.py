"""Puts the folders `plugins/` and `scenes/` into the wheel, as `optics/_data/plugins` and `optics/_data/scenes`.

Everything else is declared in pyproject.toml. A source checkout, and with it the editable install, uses the top-level
folders directly and has no `optics/_data`."""

import os
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

FOLDERS = ("plugins", "scenes")


def data_files() -> list:
    """List the files below the data folders, relative to the project, without what Python leaves behind."""
    return sorted(
        str(Path(root, name))
        for folder in FOLDERS
        for root, _, names in os.walk(folder)
        for name in names
        if "__pycache__" not in Path(root).parts and not name.startswith(".") and not name.endswith(".pyc")
    )


class BuildWithData(build_py):
    """The ordinary build, and a copy of the data folders where no source checkout stands behind the package."""

    def run(self):
        super().run()
        if self.editable_mode:
            return
        target = Path(self.build_lib, "optics", "_data")
        shutil.rmtree(target, ignore_errors=True)  # a build folder that is used again must not keep removed files
        for file in data_files():
            (target / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target / file)

    def get_source_files(self):
        return super().get_source_files() + data_files()  # the source distribution takes its list from here


setup(cmdclass={"build_py": BuildWithData})
