"""Writes the generated pages of docs/reference: flags, files, metrics and errors.

usage: reference.py BIN_DIR OUT_DIR

Flags and files come from the manuals of the programs in BIN_DIR, metrics from the sources of the server, errors from the
exceptions of the Python client, which have the names of the wire contract.
"""

import ast
import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).parents[2]
PROGRAMS = ("spikeserve", "spikectl", "spikeload", "spiketrain")
NOTE = "`make reference` writes this page from {}. Do not edit it.\n"
FLAG = re.compile(r"\.TP\n\\fB(--[\w-]+)\\fR(?:=\\fI(.*?)\\fR)?\n((?:(?!\.).*\n)*)")
METRIC = re.compile(r'"(spikeserve_\w+)"\s*\)?\s*(?:\.Help\(|,)\s*((?:"(?:[^"\\]|\\.)*"\s*)+)')
KIND = re.compile(r"Build(Counter|Gauge|Histogram)\(|(Counter|Gauge|Histogram)Family\(|\b(counter|gauge|histogram)\(")
PLACES = ("FILE", "DIR", "STORE")


def plain(text):
    """Returns the text of a manual without its escapes."""
    return text.replace("\\-", "-").replace("\\&", "").replace("\\e", "\\")


def cell(text):
    """Returns a text as a cell of a table."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def manual_of(program):
    return plain(subprocess.run([program, "--generate=man"], check=True, capture_output=True, text=True).stdout)


def sections_of(manual):
    """Returns (heading, what it does, flags) of each group or command of a manual."""
    for part in re.split(r"^\.S[SH] ", manual, flags=re.MULTILINE)[1:]:
        heading, _, text = part.partition("\n")
        flags = [(name, value, cell(about)) for name, value, about in FLAG.findall(text)]
        about = re.match(r"((?:(?!\.).*\n)*)", text)[1]
        yield heading, " ".join(about.split()), flags


def flags_page(manuals):
    page = "# Flags\n\n" + NOTE.format("the programs' manuals")
    page += "[Variables and files](../guides/watching.md#flags-variables-and-files) can set every flag.\n"
    for program, manual in manuals.items():
        page += f"\n## {program}\n"
        for heading, about, flags in sections_of(manual):
            if not flags:
                continue
            page += f"\n### {heading}\n\n" + (f"{about}\n\n" if heading.startswith(program) else "")
            page += "| flag | meaning |\n| --- | --- |\n"
            for name, value, text in flags:
                page += f"| `{name}{'=' + cell(value) if value else ''}` | {text} |\n"
    return page


def files_page(manuals):
    page = "# Files\n\n" + NOTE.format("the programs' manuals")
    page += "These flags name what a program reads or writes. [Upgrades and backups](../guides/upgrades.md) describes what to keep.\n"
    for program, manual in manuals.items():
        rows = {}
        for _, _, flags in sections_of(manual):
            rows |= {(name, value): text for name, value, text in flags if value.strip(",.").split(",")[0] in PLACES}
        if rows:
            page += f"\n## {program}\n\n| flag | file or folder |\n| --- | --- |\n"
            page += "".join(f"| `{name}={value}` | {text} |\n" for (name, value), text in rows.items())
    return page


def metrics_page():
    rows = {}
    for path in sorted((ROOT / "server").rglob("*.cc")):
        text = path.read_text()
        for metric in METRIC.finditer(text):
            kinds = KIND.findall(text[: metric.start()])
            kind = next(filter(None, kinds[-1])).lower() if kinds else "gauge"
            kind = "counter" if metric[1].endswith("_total") else kind
            rows[metric[1]] = (kind, cell("".join(ast.literal_eval(f"({metric[2]})"))))
    page = "# Metrics\n\n" + NOTE.format("the sources of the server")
    page += "[Watching a server](../guides/watching.md) draws them, and describes the alerts.\n"
    page += "\n| metric | kind | meaning |\n| --- | --- | --- |\n"
    return page + "".join(f"| `{name}` | {kind} | {text} |\n" for name, (kind, text) in sorted(rows.items()))


def errors_page():
    tree = ast.parse((ROOT / "client/python/src/spikeserve/errors.py").read_text())
    page = "# Errors\n\n" + NOTE.format("the exceptions of the Python client")
    page += "Each is the status of gRPC with its name; in C++ it is the code of an `absl::Status`. The message names the field, the\n"
    page += "expected value and the received one.\n\n| exception | is a | meaning |\n| --- | --- | --- |\n"
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            bases = ", ".join(f"`{ast.unparse(base)}`" for base in node.bases)
            page += f"| `{node.name}` | {bases} | {cell((ast.get_docstring(node) or '').replace('`', ''))} |\n"
    return page


def main(programs, out):
    found = {name: pathlib.Path(programs) / name for name in PROGRAMS}
    manuals = {name: manual_of(path) for name, path in found.items()}
    pages = {
        "flags.md": flags_page(manuals),
        "files.md": files_page(manuals),
        "metrics.md": metrics_page(),
        "errors.md": errors_page(),
    }
    for name, text in pages.items():
        (pathlib.Path(out) / name).write_text(text)


if __name__ == "__main__":
    main(*sys.argv[1:])
