"""Files whose path is built in the node, beside the parameter or from words."""

from unseen_kinds.case import Case

TWO = ("1\n", "2\n")


def reads(name: str, about: str, code: str, **words) -> Case:
    """Return a case whose node reads `gain.txt`, which changes, with code that finds its path."""
    return Case(name, about, code, **{"files": {"gain.txt": TWO}, **words})


def beside(name: str, about: str, code: str, header: str, other: str) -> Case:
    """Return a case whose parameter stays, and a file beside it changes."""
    steps = f"a: {{node: own.value, with: {{header: {header}}}}}"
    return Case(name, about, code, steps=steps, files={header: "header\n", other: TWO})


CASES = [
    reads(
        "f_string",
        "a path that an f-string builds from a number of the recipe",
        """
        @node()
        def value(*, camera: int) -> Tensor:
            return picture(Path(f"tables/camera_{camera}.txt").read_text())
        """,
        steps="a: {node: own.value, with: {camera: 3}}",
        files={"tables/camera_3.txt": TWO},
    ),
    reads(
        "percent_format",
        "a path that % builds",
        """
        @node()
        def value(*, camera: str = "ga") -> Tensor:
            with open("%sin.%s" % (camera, "txt")) as file:
                return picture(file.read())
        """,
    ),
    reads(
        "dictionary_of_paths",
        "a dictionary from sensors to paths",
        """
        TABLES = {"imx": Path("gain" + ".txt"), "mono": Path("mono" + ".txt")}

        @node()
        def value(*, sensor: str = "imx") -> Tensor:
            return picture(TABLES[sensor].read_text())
        """,
    ),
    reads(
        "helper_function",
        "a helper that makes the path",
        """
        def place(kind):
            return os.sep.join([os.getcwd(), kind + os.extsep + "txt"])

        @node()
        def value() -> Tensor:
            return picture(np.loadtxt(place("gain")))
        """,
    ),
    reads(
        "helper_module",
        "a module beside the node knows where the lab keeps its tables",
        """
        from where import tables

        @node()
        def value() -> Tensor:
            return picture(np.genfromtxt(tables() / "gain.txt"))
        """,
        files={
            "where.py": (
                "from pathlib import Path\n\ndef tables():\n    return Path.cwd() / 'lab'\n"
            ),
            "lab/gain.txt": TWO,
        },
    ),
    beside(
        "envi_cube",
        "the header cube.hdr is the parameter, the numbers are in cube.img",
        """
        @node()
        def value(*, header: DataFile) -> Tensor:
            return picture(np.loadtxt(Path(header).with_suffix(".img")))
        """,
        "cube.hdr",
        "cube.img",
    ),
    beside(
        "parent_slash_name",
        "header.parent / 'flat.txt'",
        """
        @node()
        def value(*, header: DataFile) -> Tensor:
            return picture((Path(header).parent / "flat.txt").read_text())
        """,
        "dark.txt",
        "flat.txt",
    ),
    beside(
        "with_name",
        "a sidecar by with_name",
        """
        @node()
        def value(*, header: DataFile) -> Tensor:
            frame = Path(header)
            return picture(frame.with_name(frame.stem + "_exposure" + frame.suffix).read_bytes())
        """,
        "frame.txt",
        "frame_exposure.txt",
    ),
    beside(
        "dirname_join",
        "os.path.join of the folder of the parameter",
        """
        @node()
        def value(*, header: DataFile) -> Tensor:
            folder, name = os.path.split(str(header))
            return picture(open(os.path.join(folder, name.replace("raw", "xmp"))).read())
        """,
        "shot.raw",
        "shot.xmp",
    ),
    beside(
        "string_replace",
        "str(path).replace, as many scripts do",
        """
        @node()
        def value(*, header: DataFile) -> Tensor:
            return picture(np.loadtxt(str(header).replace("left", "right")))
        """,
        "left.csv",
        "right.csv",
    ),
    reads(
        "glob_of_folder",
        "counts the frames of a folder",
        """
        @node()
        def value(*, pattern: str = "frames/*.txt") -> Tensor:
            import glob

            return picture(len(glob.glob(pattern)))
        """,
        files={"frames/1.txt": "1", "frames/2.txt": (None, "1")},
    ),
    reads(
        "iterdir_of_parent",
        "takes the newest name beside the parameter",
        """
        @node()
        def value(*, header: DataFile) -> Tensor:
            newest = max(p for p in Path(header).parent.iterdir() if p.name.startswith("dark"))
            return picture(newest.read_text())
        """,
        steps="a: {node: own.value, with: {header: light.txt}}",
        files={"light.txt": "0", "dark1.txt": "1", "dark2.txt": (None, "2")},
    ),
    reads(
        "text_parameter",
        "the path is a parameter of the type str",
        """
        @node()
        def value(*, table: str) -> Tensor:
            return picture(np.loadtxt(table))
        """,
        steps="a: {node: own.value, with: {table: gain.txt}}",
    ),
    reads(
        "list_in_a_file",
        "the parameter lists the files to average",
        """
        @node()
        def value(*, names: DataFile) -> Tensor:
            folder = Path(names).parent
            return picture(sum(float((folder / n).read_text()) for n in Path(names).read_text().split()))
        """,
        steps="a: {node: own.value, with: {names: names.lst}}",
        files={"names.lst": "one.txt gain.txt", "one.txt": "1", "gain.txt": TWO},
    ),
    reads(
        "class_attribute",
        "a class that knows its folder",
        """
        class Lab:
            folder = "la" + "b"

            def read(self, name):
                return float(open(f"{self.folder}/{name}").readline())

        @node()
        def value(*, name: str = "gain") -> Tensor:
            return picture(Lab().read(name))
        """,
        files={"lab/gain": TWO},
    ),
    reads(
        "default_argument",
        "a path as default of a helper",
        """
        def load(path=Path("gain").with_suffix(".txt")):
            return path.read_text()

        @node()
        def value() -> Tensor:
            return picture(load())
        """,
    ),
    reads(
        "whether_it_exists",
        "a flag file that exists or not",
        """
        @node()
        def value(*, flag: str = "bright") -> Tensor:
            return picture(2 if Path(flag + ".flag").exists() else 1)
        """,
        files={"bright.flag": (None, "")},
    ),
]
