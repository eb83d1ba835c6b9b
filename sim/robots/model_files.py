"""The files that a robot's model is read from: MJCF or URDF, what it includes, and its meshes."""

import os
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

_PACKAGE = "package://"
_SUFFIXES = (".stl", ".obj", ".msh", ".xml", ".mjcf")  # .msh: MuJoCo's own


@dataclass(frozen=True, kw_only=True)
class ModelFiles:
    """A model file, read but not built."""

    root: ET.Element
    """Of the XML; in a URDF the meshes' file names are absolute."""
    files: tuple[Path, ...]
    """The model file, included files and meshes."""

    @property
    def is_urdf(self) -> bool:
        """Whether it is a URDF, else an MJCF."""
        return self.root.tag == "robot"


def read_model_files(model_file: Path) -> ModelFiles:
    """Reads a model file and looks for the files that it names.

    Raises:
        ValueError: If it is neither MJCF nor URDF, or files are missing; all of them are named.
    """
    root = _parse(model_file)
    if root.tag not in ("mujoco", "robot"):
        raise ValueError(f"{model_file} must be an MJCF (<mujoco>) or a URDF (<robot>), got <{root.tag}>")
    files = [model_file]
    if root.tag == "robot":
        files += [_take_urdf_mesh(mesh, model_file) for mesh in root.iter("mesh") if mesh.get("filename")]
    else:
        files += _mjcf_files(root, (Path(os.path.abspath(model_file)),), model_file.parent)
    missing = sorted({str(file) for file in files if not file.is_file()})
    if missing:
        raise ValueError(f"{model_file} names files that are not there: {', '.join(missing)}")
    foreign = sorted({str(file) for file in files if file.suffix.lower() not in _SUFFIXES and file != model_file})
    if foreign:
        raise ValueError(f"{model_file}: meshes must be STL or OBJ files, got {', '.join(foreign)}: convert them")
    return ModelFiles(root=root, files=tuple(dict.fromkeys(Path(os.path.abspath(file)) for file in files)))


def _parse(file: Path) -> ET.Element:
    try:
        root = ET.parse(file).getroot()
    except FileNotFoundError:
        raise ValueError(f"model file expected at {file}, no such file") from None
    except (ET.ParseError, OSError, ValueError) as error:
        raise ValueError(f"{file} cannot be read as XML: {error}") from None
    for parent in list(root.iter()):
        for visual in parent.findall("visual") if root.tag == "robot" else ():
            parent.remove(visual)  # nothing is drawn of it, and its meshes are often in formats that need more packages
    return root


def _take_urdf_mesh(mesh: ET.Element, model_file: Path) -> Path:
    """Makes the file name of a URDF's mesh absolute, and returns it."""
    name = mesh.get("filename", "").removeprefix("file://")
    path = model_file.parent / name
    if name.startswith(_PACKAGE):
        package, _, rest = name.removeprefix(_PACKAGE).partition("/")
        holds = [folder for folder in model_file.resolve().parents if folder.name == package]
        if not holds:
            raise ValueError(
                f"{model_file}: mesh {name} is in package {package}, but none of the folders above is called that: put "
                "the URDF into its package, or write the mesh's path relative to the URDF"
            )
        path = holds[0] / rest
    elif "://" in name:
        raise ValueError(f"{model_file}: mesh {name} must be a file here: nothing is downloaded")
    path = Path(os.path.abspath(path))
    mesh.set("filename", str(path))
    return path


def _mjcf_files(root: ET.Element, within: tuple[Path, ...], main_folder: Path) -> list[Path]:
    """Files that an MJCF names: meshes and included files, with the files that those name.

    Args:
        root: Of the XML.
        within: Its file, behind those that include it.
        main_folder: Where the file that includes it all lies, in which meshes are looked for first.
    """
    folder = within[-1].parent
    compiler: dict[str, str] = {}
    for element in root.iter("compiler"):
        compiler |= element.attrib
    folder_of_meshes = compiler.get("meshdir", compiler.get("assetdir", ""))
    found: list[Path] = []
    for mesh in root.iter("mesh"):
        name = mesh.get("file")
        if name is not None:
            name = Path(name).name if compiler.get("strippath", "").lower() == "true" else name
            places = [place / folder_of_meshes / name for place in (main_folder, folder)] + [folder / name]
            found.append(next((place for place in places if place.is_file()), places[0]))
    for include in root.iter("include"):
        included = Path(os.path.abspath(folder / include.get("file", "")))
        found.append(included)
        if included in within:
            raise ValueError(f"{included} includes itself")
        if included.is_file():
            found += _mjcf_files(_parse(included), (*within, included), main_folder)
    return found
