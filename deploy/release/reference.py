"""Writes the generated pages of docs/reference: flags, files, metrics, alerts, errors and policies.

usage: reference.py BIN_DIR OUT_DIR

Flags and files come from the manuals of the programs in BIN_DIR, metrics from the sources of the server, alerts from the
rules of Prometheus, errors from the exceptions of the Python client, which have the names of the wire contract, policies from the records of the shipped files.
"""

import ast
import hashlib
import json
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
    page += "[Watching a server](../guides/watching.md) draws them, and [alerts](alerts.md) use them.\n"
    page += "\n| metric | kind | meaning |\n| --- | --- | --- |\n"
    return page + "".join(f"| `{name}` | {kind} | {text} |\n" for name, (kind, text) in sorted(rows.items()))


def alerts_page():
    text = (ROOT / "deploy/prometheus/alerts.yml").read_text()
    page = "# Alerts\n\n" + NOTE.format("deploy/prometheus/alerts.yml")
    page += "They fire after the last duration. [Watching a server](../guides/watching.md#the-alerts) sets them up.\n"
    page += "\n| alert | severity | what is wrong | threshold | over | after | what to check |\n| --- " + "| --- " * 6 + "|\n"
    for rule in re.split(r"\n +- (?=alert: |record: )", text):
        if not rule.startswith("alert: "):
            continue
        expression = re.search(r"expr: (.*?)\n +(?:for|labels):", rule, re.DOTALL)[1]
        threshold = re.search(r"(?:[<>]|==) *([\d.]+)", expression)[0]
        window, wait = (re.search(pattern, rule) for pattern in (r"\[(\d+\w)\]", r"\n +for: (\w+)"))
        name, severity, wrong, check = (
            re.search(rf'{key}: "?(.*?)"?\n', rule + "\n")[1] for key in ("alert", "severity", "description", "runbook")
        )
        times = (match[1] if match else "" for match in (window, wait))
        row = (f"`{name}`", severity, cell(wrong), cell(threshold), *times, cell(check.replace('\\"', '"')))
        page += f"| {' | '.join(row)} |\n"
    return page


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


def read_policy(path):
    """Returns the configuration, the record, the features and the environment of a policy file, and its SHA-256."""
    data = path.read_bytes()
    metadata = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]
    record, config = json.loads(metadata["training"]), json.loads(metadata["config"])
    return config, record, json.loads(metadata["features"]), metadata["environment"], hashlib.sha256(data).hexdigest()


def elements(features):
    """Returns the names and units of the elements of an observation or an action as a cell."""
    texts = [f"`{each['name']}`" + (f" {each['unit']}" if "unit" in each else "") for each in features]
    return ", ".join(texts if len(texts) <= 16 else [texts[0], "...", f"{texts[-1]} ({len(texts)})"])


def policy_rows(path):
    """Returns what a policy is and how it was made, what it does, and its elements, as rows of three tables."""
    config, record, features, environment, digest = read_policy(path)
    name, evaluation = f"`{path.parts[-3]}/{path.parts[-2]}`", record["evaluation"]
    sizes = f"{config['hidden_size']}, {config['heads']}, {config['layers']}, {config['ticks']}, {config['context']}, {config['ffn_size']}"
    trainings = [stage for stage in [*record["lineage"], record] if stage["command"].split()[1] == "train"]
    last = "trained through the integers" if record["command"].split()[1] == "train" else "rounded by `quantize`"
    made = f"{len(trainings)} training{'s' * (len(trainings) > 1)}, {last}"
    energy = [1e9 * evaluation["estimated_energy_joules_per_decision"][model] for model in ("int_sram_45nm", "int_45nm")]
    digits = 1 if abs(evaluation["mean_return"]) > 10 else 3
    returned = [f"{evaluation[key]:.{digits}f}" for key in ("mean_return", "std_return")]
    what = (name, environment.partition("-OneHot")[0], config["mode"], sizes, f"{path.stat().st_size / 1000:.0f}", made, f"`{digest[:12]}`")
    before = f"{record['paired_returns']['mean_returns'][0]:.{digits}f}"
    does = (name, " ± ".join(returned), before, evaluation["episodes"], f"{evaluation['spikes_per_decision']:.1f}", *(f"{nj:,.1f}" for nj in energy))
    rate = f"{features['rate_hz']:g}" if "rate_hz" in features else "-"
    robot = (name, rate, elements(features["observation"]), elements(features["action"]))
    return [f"| {' | '.join(map(str, row))} |\n" for row in (what, does, robot)]


def policies_page():
    rows = [policy_rows(path) for path in sorted((ROOT / "deploy/policies").glob("*/*/policy.safetensors"))]
    what, does, robot = ("".join(column) for column in zip(*rows))
    page = "# Policies\n\n" + NOTE.format("the records of the files in deploy/policies")
    page += "All are in integers ([design/integer.md](../design/integer.md)), and the highest version of a name is the default. `full` has the\n"
    page += "paper's phase spikes and routing, `baseline` neither. The file `lab/past_policies.md` lists all policies that were shipped before.\n"
    page += "\n| policy | task | mode | d, H, L, T, N, F | KB | made by | SHA-256 |\n| --- | --- | --- | --- | ---: | --- | --- |\n" + what
    page += "\nReturns are means and deviations over starts that no training saw, from seed 2,000,000 on; spikes and energy are those of a\n"
    page += "decision on the same starts, [estimated](energy.md) with memory (`int_sram_45nm`) and without (`int_45nm`). In float32, the policy\n"
    page += "that each was made from returns what stands beside it.\n"
    page += "\n| policy | return | in float32 | starts | spikes | `int_sram_45nm`, nJ | `int_45nm`, nJ |\n"
    page += "| --- | ---: | ---: | ---: | ---: | ---: | ---: |\n" + does
    page += "\nThe elements that a robot sends and takes, in the policy's order, with their units and the decisions per second of the training\n"
    page += "data ([wiring](../guides/wiring.md)):\n\n| policy | Hz | observation | action |\n| --- | ---: | --- | --- |\n" + robot
    return page


def main(programs, out):
    found = {name: pathlib.Path(programs) / name for name in PROGRAMS}
    manuals = {name: manual_of(path) for name, path in found.items()}
    pages = {
        "flags.md": flags_page(manuals),
        "files.md": files_page(manuals),
        "metrics.md": metrics_page(),
        "alerts.md": alerts_page(),
        "errors.md": errors_page(),
        "policies.md": policies_page(),
    }
    for name, text in pages.items():
        (pathlib.Path(out) / name).write_text(text)


if __name__ == "__main__":
    main(*sys.argv[1:])
