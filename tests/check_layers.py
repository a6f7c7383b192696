"""Checks that every include, import and link of the tree goes one way.

usage: check_layers.py BUILD_DIR

C++: BUILD_DIR/layers.json lists each library, its folder, its sources and the libraries that CMake links to it. A file
may include a header of another folder only if its own library links that folder's library, directly or through what
that one links publicly. No header may include itself through others, and the libraries must form no cycle.

CONTRIBUTING.md's map names every folder that holds a library, and no other.

Python and JavaScript: the modules of one package must not import each other in a circle.

The laboratory (lab/) may use everything, and nothing may use it: no file outside includes its headers, imports its modules or
names one of its files. Pages may link to it.
"""

import ast
import json
import os
import re
import subprocess
import sys

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
INCLUDE = re.compile(r'^#include "([^"]+)"', re.MULTILINE)
JS_IMPORT = re.compile(r"""^\s*(?:import|export)\b[^'"]*?['"](\.[^'"]+)['"]""", re.MULTILINE)

# Rooms whose modules include each other in a circle: an interface with the function that makes its implementations, or the
# halves of one subject.
OPEN_CIRCLES = {
    "client/src",
    "core/dataset",
    "core/engine/spiking",
    "core/engine/spiking/kernels",
    "core/environment",
    "server/agent",
    "server/transport",
    "server/web",
    "train/expert",
}


def tracked(*patterns):
    """Returns the files of the tree that match git's patterns, relative to its root."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", *patterns]
    names = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return sorted(name for name in names.split("\0") if name and os.path.exists(os.path.join(ROOT, name)))


def read(name):
    with open(os.path.join(ROOT, name), encoding="utf-8") as file:
        return file.read()


def module_of(path):
    """Returns the path of a C++ file without its extension, the same for a header and its source."""
    stem = os.path.splitext(path)[0].replace("client/engine/include/spikeserve/", "client/engine/")
    return stem.replace("client/include/spikeserve/", "client/src/")


def find_cycle(graph):
    """Returns one cycle of `graph`, a dict from a node to its successors, as a list of nodes; empty if it has none."""
    done, path = set(), []

    def visit(node):
        if node in done:
            return []
        if node in path:
            return path[path.index(node) :] + [node]
        path.append(node)
        for successor in sorted(graph.get(node, ())):
            if cycle := visit(successor):
                return cycle
        path.pop()
        done.add(node)
        return []

    for node in sorted(graph):
        if cycle := visit(node):
            return cycle
    return []


def public_closure(libraries, name, seen):
    """Adds `name` and every library that it links publicly to `seen`."""
    if name in libraries and name not in seen:
        seen.add(name)
        for dependency in libraries[name]["public"]:
            public_closure(libraries, dependency, seen)


def check_cpp(layers):
    """Returns complaints about includes across libraries that are not linked, and about cycles."""
    libraries = {entry["name"]: entry for entry in layers}
    complaints = []
    graph = {n: [d for d in e["public"] + e["private"] if d in libraries] for n, e in libraries.items()}
    if cycle := find_cycle(graph):
        complaints.append("libraries link each other in a circle: " + " -> ".join(cycle))

    folders = {}  # folder -> its libraries
    stems = {}  # path of a source without its extension -> its library
    for name, entry in libraries.items():
        folders.setdefault(entry["folder"], set()).add(name)
        for source in entry["sources"]:
            stems[os.path.splitext(os.path.normpath(os.path.join(entry["folder"], source)))[0]] = name

    def owners(path):
        """Returns the library that compiles the file or its .cc; without one, all of its folder."""
        stem = module_of(path)
        if stem in stems:
            return {stems[stem]}
        folder = os.path.dirname(path)
        while folder and folder not in folders:
            if os.path.exists(os.path.join(ROOT, folder, "CMakeLists.txt")):
                return set()  # an option leaves its library out of this build
            folder = os.path.dirname(folder)
        return folders.get(folder, set())

    headers = {}  # as included -> path in the tree
    for path in tracked("*.h"):
        headers[path] = path
        headers[re.sub(r"^client/(engine/)?include/", "", path)] = path

    includes = {}
    for path in tracked("*.h", "*.cc"):
        includes[path] = [headers[h] for h in INCLUDE.findall(read(path)) if h in headers]
        if path.startswith(("tests/", "lab/tests/")):
            continue
        reachable = set()
        for owner in owners(path):
            for dependency in [owner, *libraries[owner]["public"], *libraries[owner]["private"]]:
                public_closure(libraries, dependency, reachable)
        for header in includes[path]:
            needed = owners(header)
            if needed and owners(path) and not needed & reachable:
                complaints.append(f"{path} includes {header}: {'/'.join(owners(path))} does not link {'/'.join(needed)}")
            if header.startswith("server/") and not path.startswith(("server/", "lab/")):
                complaints.append(f"{path} includes {header}: only server/ may include server/")
    if cycle := find_cycle(includes):
        complaints.append("headers include each other in a circle: " + " -> ".join(cycle))
    return complaints + check_modules(includes)


def check_modules(includes):
    """Returns complaints about modules that include each other in a circle. `includes` is a dict from a file to headers."""
    graph = {}
    for path, headers in includes.items():
        module = module_of(path)
        for other in set(map(module_of, headers)) - {module}:
            if not {os.path.dirname(module), os.path.dirname(other)} <= OPEN_CIRCLES:
                graph.setdefault(module, set()).add(other)
    if cycle := find_cycle(graph):
        return ["modules include each other in a circle: " + " -> ".join(cycle)]
    return []


def check_map(layers):
    """Returns complaints about components that CONTRIBUTING.md's map does not name, and about folders that are none.

    A component may be absent from `layers` because an option leaves it out of this build.
    """
    components = set(re.findall(r"^\| `([^`]+)` \|", read("CONTRIBUTING.md"), re.MULTILINE))
    folders = {entry["folder"] for entry in layers if not entry["folder"].startswith(("tests", "lab"))}
    absent = [component for component in sorted(components - folders) if not tracked(f"{component}/CMakeLists.txt")]
    return [f"CONTRIBUTING.md: the map of the components does not name {folder}" for folder in sorted(folders - components)] + [
        f"CONTRIBUTING.md: the map of the components names {component}, which is none" for component in absent
    ]


def python_imports(path, modules):
    """Returns the modules of `modules` that the file imports, at any depth of its code."""
    package = os.path.dirname(path)
    for node in ast.walk(ast.parse(read(path))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            names = [base] + [f"{base}.{alias.name}" if base else alias.name for alias in node.names]
        for name in names:
            file = os.path.join(package, name.split(".")[-1] + ".py")
            if file in modules:
                yield file


LAB_PATH = re.compile(r"(?<![\w.-])lab/\w")
# Where the product meets the laboratory: hooks and make know its folder, a generated page names a file, this file checks it.
LAB_DOORS = {".pre-commit-config.yaml", "Makefile", "deploy/release/reference.py", "tests/check_layers.py"}


def imported(path):
    """Returns the top names of all modules that a Python file imports, at any depth of its code."""
    for node in ast.walk(ast.parse(read(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.split(".")[0]


def check_lab():
    """Returns complaints about files outside lab/ that use it."""
    complaints = []
    scripts = tracked("*.py")
    stems = {path: os.path.splitext(os.path.basename(path))[0] for path in scripts}
    outside = {stem for path, stem in stems.items() if not path.startswith("lab/")}
    modules = {stem for path, stem in stems.items() if path.startswith("lab/")} - outside
    for path in scripts:
        if not path.startswith("lab/") and (used := sorted(modules.intersection(imported(path)))):
            complaints.append(f"{path} imports {', '.join(used)}: only lab/ may use lab/")
    code = ("*.h", "*.cc", "*.py", "*.sh", "*.js", "*.cmake", "*CMakeLists.txt", "Makefile", "*.toml", "*.json", "*.yaml", "*.yml")
    for path in tracked(*code):
        if not path.startswith("lab/") and path not in LAB_DOORS and LAB_PATH.search(read(path)):
            complaints.append(f"{path} names a file of lab/: only lab/ may use lab/")
    return complaints


def check_scripts():
    """Returns complaints about circles among Python and JavaScript modules."""
    complaints = []
    python = set(tracked("*.py"))
    graph = {p: set(python_imports(p, python)) - {p} for p in python if not p.endswith("__init__.py")}
    if cycle := find_cycle(graph):
        complaints.append("Python modules import each other in a circle: " + " -> ".join(cycle))
    scripts = [p for p in tracked("*.js") if "/vendor/" not in p]
    graph = {
        p: [os.path.normpath(os.path.join(os.path.dirname(p), i)) for i in JS_IMPORT.findall(read(p))] for p in scripts
    }
    if cycle := find_cycle(graph):
        complaints.append("JavaScript modules import each other in a circle: " + " -> ".join(cycle))
    return complaints


def main():
    with open(os.path.join(sys.argv[1], "layers.json"), encoding="utf-8") as file:
        layers = json.load(file)
    complaints = check_cpp(layers) + check_map(layers) + check_scripts() + check_lab()
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    print(f"check_layers: {len(layers)} libraries, {len(complaints)} complaints")
    sys.exit(1 if complaints else 0)


if __name__ == "__main__":
    main()
