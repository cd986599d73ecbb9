"""The version is the same everywhere, and the files that release it fit the project."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

import harnack as hk
from tests.project.scripts import ROOT, load_script

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

release = load_script("release_notes.py")
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))


def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def recipe() -> dict[str, Any]:
    return yaml.safe_load((ROOT / "conda/recipe/recipe.yaml").read_text(encoding="utf-8"))


def test_the_last_release_is_the_same_everywhere() -> None:
    """Between releases the sources have a version of development, and these files the last one."""
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    titles = re.findall(r"^## \[(.+)\](?: - (.+))?$", changelog, re.MULTILINE)
    assert titles[0] == ("Unreleased", "")
    version, date = titles[1]
    assert release.only_match(ROOT / "CITATION.cff", r"^version: (\S+)$") == version
    assert release.only_match(ROOT / "CITATION.cff", r"^date-released: (\S+)$") == date
    assert recipe()["context"]["version"] == version
    if ".dev" not in hk.__version__:
        assert hk.__version__ == version
        assert release.release_notes(ROOT, f"v{version}").startswith("The first version")


def write_project(folder: Path, version: str, cited: str, changelog: str) -> Path:
    (folder / "src/harnack").mkdir(parents=True)
    (folder / "src/harnack/_version.py").write_text(f'__version__ = "{version}"\n')
    (folder / "CITATION.cff").write_text(f"version: {cited}\ndate-released: 2027-01-02\n")
    (folder / "CHANGELOG.md").write_text(changelog)
    return folder


CHANGELOG = (
    "# A\n\n## [Unreleased]\n\n## [1.2.3] - 2027-01-02\n\n- new\n\n## [1.2.2] - 2026-01-01\n"
)


def test_notes_of_a_release_are_its_section(tmp_path: Path) -> None:
    root = write_project(tmp_path, "1.2.3", "1.2.3", CHANGELOG)
    assert release.release_notes(root, "v1.2.3") == "- new\n"


@pytest.mark.parametrize(
    ("tag", "version", "cited", "changelog", "message"),
    [
        ("v1.2.4", "1.2.3", "1.2.3", CHANGELOG, r"the tag is v1\.2\.4"),
        ("v1.3.0.dev0", "1.3.0.dev0", "1.2.3", CHANGELOG, "no version to release"),
        ("v1.2.3", "1.2.3", "1.2.2", CHANGELOG, r"CITATION\.cff has version 1\.2\.2"),
        ("v1.2.4", "1.2.4", "1.2.4", CHANGELOG, r"no text below `## \[1\.2\.4\]"),
        ("v1.2.2", "1.2.2", "1.2.2", CHANGELOG, "no text below"),
        ("v1.2.3", "1.2.3", "1.2.3", CHANGELOG.replace("2027-01-02", "2027-01-03"), "has the date"),
    ],
)
def test_a_tag_that_does_not_fit_is_refused(
    tag: str, version: str, cited: str, changelog: str, message: str, tmp_path: Path
) -> None:
    root = write_project(tmp_path, version, cited, changelog)
    with pytest.raises(ValueError, match=message):
        release.release_notes(root, tag)


def steps(workflow: Path) -> list[dict[str, Any]]:
    jobs = yaml.safe_load(workflow.read_text(encoding="utf-8"))["jobs"]
    return [step for job in jobs.values() for step in job["steps"]]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_use_what_there_is(workflow: Path) -> None:
    """Actions of one major version each, targets of the Makefile, scripts and extras."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    extras = project()["project"]["optional-dependencies"]
    used = [step["uses"] for step in steps(workflow) if "uses" in step]
    assert used
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@(?:v\d+|release/v\d+)", action) for action in used)
    for command in "\n".join(step.get("run", "") for step in steps(workflow)).splitlines():
        for target in re.findall(r"\bmake ([a-z-]+)", command):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), command
        for path in re.findall(r"(?:python |^)(\.?\w+/\w+(?:\.py)?)", command):
            assert (ROOT / path).exists(), command
        for extra in re.findall(r"--editable '?\.\[(\w+)\]", command):
            assert extra in extras, command


def test_the_versions_of_python_are_those_that_are_tested() -> None:
    settings = project()["project"]
    claimed = [
        found[1]
        for classifier in settings["classifiers"]
        if (found := re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", classifier))
    ]
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8"))
    assert workflow["jobs"]["linux"]["strategy"]["matrix"]["python-version"] == claimed
    assert settings["requires-python"] == f">={claimed[0]}"


# Packages that have another name at conda-forge, or another package in their place.
CONDA_NAMES = {
    "karellen-llvm-core": "libllvm19",
    "lazy-loader": "lazy_loader",
    "mapbox-earcut": "mapbox_earcut",
    "openexr": "openexr-python",
}


def test_the_recipe_requires_what_the_project_does() -> None:
    run = {
        line.partition(" ")[0]: line.partition(" ")[2] for line in recipe()["requirements"]["run"]
    }
    assert run.pop("python") == ">=${{ python_min }}"
    assert recipe()["context"]["python_min"] == project()["project"]["requires-python"][2:]
    expected = {"__unix": "", "libllvm19": ""}
    for requirement in project()["project"]["dependencies"]:
        found = re.match(r"([\w-]+)([^;]*)", requirement)
        assert found is not None
        name = CONDA_NAMES.get(found[1], found[1])
        expected.setdefault(name, found[2].strip())
    assert run == expected


def test_the_recipe_builds_with_the_same_hatchling() -> None:
    (backend,) = project()["build-system"]["requires"]
    assert backend.replace("==", " ==") in recipe()["requirements"]["host"]
    extras = project()["project"]["optional-dependencies"]
    assert backend in extras["dist"]
    assert backend in extras["dev"]


def test_the_recipe_has_the_command_and_the_license() -> None:
    (name, place) = next(iter(project()["project"]["scripts"].items()))
    assert recipe()["build"]["python"]["entry_points"] == [f"{name} = {place}"]
    assert recipe()["about"]["license"] == project()["project"]["license"]
    assert (ROOT / recipe()["about"]["license_file"]).exists()
    assert recipe()["about"]["summary"] == project()["project"]["description"]
