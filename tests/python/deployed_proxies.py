"""Runs nginx, HAProxy and Envoy with the configurations of deploy/."""

import contextlib
import os
import shutil
import subprocess

import pytest
from serving import DEADLINE_SECONDS, DEPLOY

PROXIES = ("nginx", "haproxy", "envoy")
NGINX = """
daemon off;
pid {path}/nginx.pid;
events {{}}
http {{
  access_log off;
  client_body_temp_path {path};
  proxy_temp_path {path};
  fastcgi_temp_path {path};
  uwsgi_temp_path {path};
  scgi_temp_path {path};
  include {path}/configuration.yaml;
}}
"""


def installed(name):
    """Returns the path of a program. Skips the test if it is not installed, and fails it in CI."""
    path = shutil.which(name, path=f"{os.environ['SPIKESERVE_INTEROP']}/bin:{os.environ['PATH']}:/usr/sbin")
    if path is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)(f"without {name}")
    return path


@contextlib.contextmanager
def running(name, file, path, certificates, parts):
    """Runs a proxy with a file of deploy/NAME, in which each of `parts` occurs once and is replaced. `path` is its folder."""
    program = installed(name)
    text = (DEPLOY / name / file).read_text()
    for part, value in parts.items():
        assert text.count(part) == 1, f"{part}: expected once, received {text.count(part)} times"
        text = text.replace(part, str(value))
    for part in ("server.pem", "server.key"):
        text = text.replace(f"/etc/spikeserve/{part}", str(certificates / part))
    text = text.replace("/etc/haproxy/spikeserve.pem", str(path / "spikeserve.pem"))
    assert not any(text.count(rest) for rest in ("/etc/spikeserve/", "/etc/haproxy/", "10.0.0."))
    configuration = path / "configuration.yaml"
    configuration.write_text(text)
    (path / "nginx.conf").write_text(NGINX.format(path=path))
    both = (certificates / "server.pem").read_text() + (certificates / "server.key").read_text()
    (path / "spikeserve.pem").write_text(both)
    flags = {
        "nginx": ["-p", path, "-e", "stderr", "-c", path / "nginx.conf"],
        "haproxy": ["-q", "-db", "-f", configuration],
        "envoy": ["--config-path", configuration, "--concurrency", "1", "--use-dynamic-base-id", "--log-level", "error"],
    }
    process = subprocess.Popen([program, *flags[name]])
    try:
        yield
    finally:
        process.terminate()
        process.wait(timeout=DEADLINE_SECONDS)
