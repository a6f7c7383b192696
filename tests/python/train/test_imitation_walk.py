"""Walks the reacher's page as it is printed, from an environment to a foreign client that plays the policy.

In a small form; test_imitate.py has the long one.
"""

import re

from documentation import Shell, files_of

SMALL = (
    "--steps=6000 --iterations=150 --rounds=1 --round-steps=1500 --round-iterations=60 --hidden-size=32 --layers=1 "
    "--silence= --selection-episodes=16 --episodes=16 --train-flags='--slope=4 --heads=2'"
)


def walk(folder, flags=""):
    """Returns what the two Python commands of the page print, with flags for the training."""
    for name, text in files_of("imitation.md").items():
        (folder / name).write_text(text)
    train = "imitate reacher:Reacher2D-v0 --expert reacher:reach"
    with Shell(folder) as shell:
        trained, played = shell.run("imitation.md", [(train, f"{train} {flags} 2>&1")])
    return trained, float(re.fullmatch(r"mean return of 20 starts: (-\d+\.\d)\n", played)[1])


def test_the_reacher_is_trained_served_and_played_by_another_client(tmp_path):
    trained, mean_return = walk(tmp_path, SMALL)
    context = re.search(r"^chosen: context = (\d+): observations with which the expert's action", trained, re.MULTILINE)[1]
    assert "chosen: burst_rate = 0.3, longest_burst = 8: " in trained
    assert "on the first 16 of these starts, with the error on held-out episodes:\n" in trained
    for name in ("the policy", "line on 2 frames", "mlp on 4 frames"):
        assert re.search(rf"^{name}: return -\S+ ± \S+, error \d\.\d{{4}}$", trained, re.MULTILINE)
    assert mean_return > -150  # without forces: -413
    report = (tmp_path / "reacher2d/report.md").read_text()
    assert f"- context = {context}: observations with which" in report
    assert f"| `context` | `{context}` |" in report
