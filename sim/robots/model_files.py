"""The files that a robot's model is read from: MJCF or URDF, what it includes, and its meshes."""

import importlib
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

_PACKAGE = "package://"
MENAGERIE = "menagerie:"  # what a model of MuJoCo Menagerie begins with
_SUFFIXES = (".stl", ".obj", ".msh", ".xml", ".mjcf", ".png")  # .msh: MuJoCo's own


class ModelFiles(NamedTuple):
    """A model file, read but not built."""

    root: ET.Element  # root of the XML; in a URDF the meshes' file names are absolute
    files: tuple[Path, ...]  # the model file, included and attached files, meshes and textures

    @property
    def is_urdf(self) -> bool:
        """Whether it is a URDF, else an MJCF."""
        return self.root.tag == "robot"


def find_model(name: str | Path, folder: Path = Path()) -> Path:
    """The file of a model: a path below ``folder``, ``menagerie:unitree_go2``, or ``menagerie:unitree_go2/go2_mjx``."""
    robot_name, _, model_name = str(name).removeprefix(MENAGERIE).partition("/")
    if not str(name).startswith(MENAGERIE):
        return folder / name
    try:
        import mujoco_menagerie as menagerie  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(f"{name} needs MuJoCo Menagerie: pip install 'faultline[menagerie]'") from None
    try:
        robot = menagerie.get(robot_name)
        return robot.xml(model_name or robot.default_model)
    except menagerie.MenagerieError as error:
        raise ValueError(f"{name}: {error}") from None


def find_above(name: str, folder: Path) -> Path | None:
    """The file that a file of ``folder`` names, there, or above if its name has a folder; None if it is not there.

    ``{LEGGED_GYM_ROOT_DIR}/``, ``package://`` and a package's name are left out.
    """
    path = Path(re.sub(r"^(\{\w+\}/|package://)", "", name))
    paths = [path, Path(*path.parts[1:])] if name.startswith(_PACKAGE) else [path]
    folders = [folder, *folder.resolve().parents][: None if len(path.parts) > 1 else 1]
    return next((file for path in paths for parent in folders if (file := parent / path).is_file()), None)


def find_robot_of_scene(model_file: Path) -> Path:
    """The file that a scene includes for its robot; ``model_file`` itself if it has bodies, or is no MJCF."""
    root = _parse_xml(model_file)
    names = [element.get("file", "") for element in root.findall("include")]
    is_scene = root.tag == "mujoco" and len(names) == 1 and root.find("worldbody/body") is None
    return model_file.parent / names[0] if is_scene else model_file


def _parse_xml(model_file: Path) -> ET.Element:
    try:
        return ET.parse(model_file).getroot()
    except FileNotFoundError:
        raise ValueError(f"model file expected at {model_file}, no such file") from None
    except (ET.ParseError, OSError, ValueError) as error:
        raise ValueError(f"{model_file} cannot be read as XML: {error}") from None


def read_model_files(model_file: Path, *, visuals: bool = False) -> ModelFiles:
    """Reads an MJCF or URDF and looks for the files that it names; with ``visuals`` a URDF keeps those it can show."""
    root = _parse_xml(model_file)
    if root.tag not in ("mujoco", "robot"):
        raise ValueError(f"{model_file} must be an MJCF (<mujoco>) or a URDF (<robot>), got <{root.tag}>")
    elements = [(parent, visual) for parent in root.iter() for visual in parent.findall("visual")]
    for parent, visual in elements if root.tag == "robot" else ():
        if not (visuals and _can_be_shown(visual, model_file)):  # meshes are often in formats that need more packages
            parent.remove(visual)
    for element in root.iter():
        marks = [value for value in element.attrib.values() if "${" in value or "$(" in value]
        if marks := marks + [element.tag] * ("xacro" in element.tag):
            remedy = f"make one of it, `xacro {model_file.name} > {model_file.stem}.expanded.urdf`"
            raise ValueError(f"{model_file} is a xacro file ({marks[0]}), expected a URDF: {remedy}")
    files = _mjcf_files(model_file) if root.tag == "mujoco" else _urdf_files(root, model_file)
    if missing := sorted({str(file) for file in files if not file.is_file()}):
        raise ValueError(f"{model_file} names files that are not there: {', '.join(missing)}")
    if foreign := sorted({str(file) for file in files[1:] if file.suffix.lower() not in _SUFFIXES}):
        raise ValueError(f"{model_file}: meshes must be STL or OBJ files, got {', '.join(foreign)}: convert them")
    return ModelFiles(root=root, files=tuple(dict.fromkeys(Path(os.path.abspath(file)) for file in files)))


def _urdf_files(root: ET.Element, model_file: Path) -> list[Path]:
    if problems := [f"{model_file}: {problem}" for problem in _urdf_problems(root)]:
        raise ValueError("; ".join(problems))
    files = [model_file]
    for mesh in root.iter("mesh"):
        if mesh.get("filename"):
            files.append(_mesh_path(mesh, model_file))
            mesh.set("filename", str(files[-1]))
    return files


def _urdf_problems(root: ET.Element) -> Iterator[str]:
    """Complaints about joints that MuJoCo accepts, or refuses without their name."""
    links = [link.get("name") for link in root.findall("link")]
    for joint in root.findall("joint"):
        name = f"joint {joint.get('name', 'without a name')}"
        for end in (*joint.findall("parent"), *joint.findall("child")):
            if end.get("link") not in links:
                yield f"{name}: no link named {end.get('link')}, the file has {', '.join(map(str, links))}"
        mimic = joint.find("mimic")
        if mimic is not None and mimic.get("joint") not in [other.get("name") for other in root.findall("joint")]:
            yield f"{name} follows {mimic.get('joint')}, no joint of the file"
        limit = joint.find("limit")
        ends = [key for key in ("lower", "upper") if limit is not None and limit.get(key) is None]
        missing = "<limit>" if limit is None else ends[0] if len(ends) == 1 else ""  # without both it moves freely
        if missing and joint.get("type") in ("revolute", "prismatic"):
            yield f'{name} has no {missing}: give it <limit lower="-1.5" upper="1.5" effort="30" velocity="20"/>'
        if limit is not None and limit.get("effort", "").strip().startswith("-"):
            yield f"{name} must have an effort above 0, got {limit.get('effort')}"


def _can_be_shown(visual: ET.Element, model_file: Path) -> bool:
    """Whether a URDF's visual is a primitive, or its mesh is there in a format that can be read."""
    try:
        meshes = [_mesh_path(mesh, model_file) for mesh in visual.iter("mesh")]
    except ValueError:
        return False
    return all(path.suffix.lower() in _SUFFIXES and path.is_file() for path in meshes)


def _mesh_path(mesh: ET.Element, model_file: Path) -> Path:
    """Path of a URDF's mesh, whether or not it exists."""
    name = mesh.get("filename", "").removeprefix("file://")
    path = find_above(name, model_file.parent)
    if path is None and name.startswith(_PACKAGE):
        package = name.removeprefix(_PACKAGE).partition("/")[0]
        remedy = "put the URDF into its package, or write the mesh's path relative to the URDF"
        raise ValueError(f"{model_file}: mesh {name} is not in package {package} of a folder above: {remedy}")
    if path is None and "://" in name:
        raise ValueError(f"{model_file}: mesh {name} must be a file here: nothing is downloaded")
    return Path(os.path.abspath(path or model_file.parent / name))


def _mjcf_files(model_file: Path) -> list[Path]:
    """An MJCF and what it names, as MuJoCo looks for it: in its own folder first, then beside what it includes."""
    mj: Any = importlib.import_module("mujoco")  # takes long to load: not for the help of commands
    try:
        named = sorted(map(Path, mj.mju_getXMLDependencies(os.path.abspath(model_file))))
    except mj.FatalError as error:
        raise ValueError(f"{model_file} cannot be read by MuJoCo: {error}") from None
    home = os.path.abspath(model_file.parent)
    folders = [file.parent for file in named if file.suffix in (".xml", ".mjcf")]
    files = [model_file]
    for file in named:
        paths = [file, *(folder / os.path.relpath(file, home) for folder in folders)]
        paths += [folder / file.name for folder in file.parents]  # by strippath
        files.append(next((path for path in paths if path.is_file()), file))
    return files
