"""`python -m spikeserve.hubs` brings policy files from and to hubs, by the libraries of these. Here are local ones.

The libraries are in an environment of their own, tests/hubs, as is `model_signing`, whose bundles a server accepts.
"""

import base64
import contextlib
import hashlib
import http.server
import json
import os
import pathlib
import re
import shutil
import subprocess
import threading

import pytest
from security import openssl
from serving import SHIPPED_POLICIES, refusal_at_start, running_server

PROGRAMS = pathlib.Path(__file__).parents[3] / "build/hubs/venv/bin"
REGISTRY = "version: 0.1\nstorage: {{filesystem: {{rootdirectory: {}}}}}\nhttp: {{addr: '127.0.0.1:0'}}\n"
REVISION = "0" * 40


@contextlib.contextmanager
def listening(command, says):
    """Starts a server that says its address in stderr, and yields the address."""
    with subprocess.Popen([str(part) for part in command], stderr=subprocess.PIPE, text=True) as process:
        try:
            found = next(filter(None, (re.search(says, line) for line in process.stderr)))
            threading.Thread(target=process.stderr.read, daemon=True).start()
            yield found[1]
        finally:
            process.kill()


class HuggingFace(http.server.BaseHTTPRequestHandler):
    """The calls that huggingface_hub makes for one file, by one who may write."""

    files = {}  # by path

    def log_message(self, *_):
        pass

    def answer(self, content, status=200, **headers):
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for key, value in {"Content-Length": len(body), "X-Repo-Commit": REVISION, **headers}.items():
            self.send_header(key.replace("_", "-"), str(value))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_GET(self):  # noqa: N802
        if self.path.startswith("/api/"):
            return self.answer({"id": "fleet/robots", "sha": REVISION})
        path = re.sub(rf".*/resolve/({REVISION}|main)/", "", self.path)
        if path not in self.files:
            return self.answer(b"", 404, X_Error_Code="EntryNotFound")
        content = self.files[path]
        return self.answer(content, ETag=f'"{hashlib.sha256(content).hexdigest()}"')

    do_HEAD = do_GET  # noqa: N815

    def do_POST(self):  # noqa: N802
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if "/preupload/" in self.path:
            modes = {"uploadMode": "regular", "shouldIgnore": False}
            return self.answer({"files": [{"path": each["path"], **modes} for each in json.loads(body)["files"]]})
        for line in map(json.loads, body.splitlines()):
            if line["key"] == "file":
                self.files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
            elif line["key"] == "deletedFile":
                del self.files[line["value"]["path"]]
        commit = f"http://{self.headers['Host']}/fleet/robots/commit/{REVISION}"
        return self.answer({"commitUrl": commit, "commitOid": REVISION})


@contextlib.contextmanager
def hf(tmp_path):
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), HuggingFace) as server:
        HuggingFace.files.clear()
        threading.Thread(target=server.serve_forever, daemon=True).start()
        environment = {"HF_ENDPOINT": f"http://127.0.0.1:{server.server_port}", "HF_TOKEN": "x", "HF_HUB_DISABLE_XET": "1"}
        yield "hf://fleet/robots/cartpole/policy", {**environment, "HF_HOME": str(tmp_path)}
        server.shutdown()


@contextlib.contextmanager
def s3(tmp_path):
    with listening([PROGRAMS / "moto_server", "-p", "0"], r"Running on (http\S+)") as address:
        keys = {"AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_DEFAULT_REGION": "us-east-1"}
        environment = {**keys, "AWS_ENDPOINT_URL": address}
        make = "import boto3; boto3.client('s3').create_bucket(Bucket='fleet')"
        subprocess.run([PROGRAMS / "python", "-c", make], env=environment, check=True)
        yield "s3://fleet/cartpole/policy", environment


@contextlib.contextmanager
def oci(tmp_path):
    (tmp_path / "registry.yml").write_text(REGISTRY.format(tmp_path / "registry"))
    command = ["docker-registry", "serve", tmp_path / "registry.yml"]
    with listening(command, r"listening on (127\S+?)\"") as address:
        yield f"oci://{address}/fleet/cartpole:3", {}


def hubs(environment, *arguments, status=0):
    command = [PROGRAMS / "python", "-m", "spikeserve.hubs", "--plain_http", *arguments]
    path = {name: os.environ[name] for name in ("PATH", "PYTHONPATH")}
    done = subprocess.run(command, env=path | environment, capture_output=True, text=True)
    assert done.returncode == status, done.stderr
    return done.stdout + done.stderr


@pytest.mark.parametrize("hub", [hf, s3, oci])
def test_a_hub_gives_back_what_it_got(hub, tmp_path):
    pushed, pulled = tmp_path / "pushed.safetensors", tmp_path / "pulled.safetensors"
    signature = pulled.with_name("pulled.safetensors.sig")
    shutil.copy(SHIPPED_POLICIES / "cartpole/1/policy.safetensors", pushed)
    with hub(tmp_path) as (place, environment):
        assert place in hubs(environment, "pull", place, pulled, status=1)
        assert not pulled.exists()
        digest = hashlib.sha256(pushed.read_bytes()).hexdigest()
        assert digest in hubs(environment, "push", pushed, place)
        signature.write_text("of another file")
        assert digest in hubs(environment, "pull", place, pulled)
        assert pulled.read_bytes() == pushed.read_bytes()
        assert not signature.exists()
        pushed.write_bytes(b"new")
        pushed.with_name("pushed.safetensors.sig").write_bytes(b"of the new one")
        hubs(environment, "push", pushed, place)
        hubs(environment, "pull", place, pulled)
        assert (pulled.read_bytes(), signature.read_bytes()) == (b"new", b"of the new one")
        pushed.write_bytes(b"unsigned")
        pushed.with_name("pushed.safetensors.sig").unlink()
        hubs(environment, "push", pushed, place)
        hubs(environment, "pull", place, pulled)
        assert (pulled.read_bytes(), signature.exists()) == (b"unsigned", False)


def test_wrong_places_are_refused():
    for place in ("ftp://fleet/policy", "hf://fleet", "s3://fleet", "oci://fleet"):
        assert f"received {place}" in hubs({}, "push", "x", place, status=1)


@pytest.mark.parametrize("curve", ["P-256", "P-384", "P-521"])
def test_bundles_of_model_signing_are_accepted(curve, tmp_path):
    for name in ("ours", "other"):
        openssl("genpkey", "-algorithm", "ec", "-pkeyopt", f"ec_paramgen_curve:{curve}", "-out", f"{name}.key", cwd=tmp_path)
    openssl("pkey", "-in", "ours.key", "-pubout", "-out", "trusted.pem", cwd=tmp_path)
    folder = tmp_path / "policies"
    for version in ("1", "2"):
        shutil.copytree(SHIPPED_POLICIES / "cartpole" / version, folder / "cartpole" / version)
    (first, second) = (folder / f"cartpole/{version}/policy.safetensors" for version in (1, 2))

    def sign(what, signature, key="ours"):
        command = [PROGRAMS / "model_signing", "sign", "key", "--private_key", tmp_path / f"{key}.key"]
        subprocess.run([*command, "--signature", signature, what], check=True, capture_output=True)

    def is_refused(part):
        assert part in refusal_at_start(f"--trusted_keys={tmp_path}/trusted.pem", policies=folder)

    sign(folder, tmp_path / "all.sig")  # names both policies and numbers
    for policy in (first, second):
        shutil.copy(tmp_path / "all.sig", f"{policy}.sig")
    sign(second, f"{second}.sig")  # the content alone
    pushed = tmp_path / "tree/cartpole/3/policy.safetensors"
    pushed.parent.mkdir(parents=True)
    shutil.copy(SHIPPED_POLICIES / "cartpole-small/1/policy.safetensors", pushed)
    sign(tmp_path / "tree", f"{pushed}.sig")
    with running_server(folder, [f"--trusted_keys={tmp_path}/trusted.pem"]) as server:
        assert len(server.agent.ListPolicies().policies) == 2
        push = ("push", pushed, "--policy=cartpole")
        assert "expected a bundle with SHA-256" in server.spikectl(*push, "--version=4", status=1).stderr
        server.spikectl(*push, "--version=3")
        server.spikectl("pull", tmp_path / "pulled", "--policy=cartpole", "--version=3")
        assert (tmp_path / "pulled.sig").read_bytes() == pathlib.Path(f"{pushed}.sig").read_bytes()
    shutil.rmtree(folder / "cartpole/2")
    shutil.rmtree(folder / "cartpole/3")
    sign(first, f"{first}.sig", "other")
    is_refused("expected a bundle by one of the 1 keys")
    shutil.copy(f"{pushed}.sig", f"{first}.sig")
    is_refused("received one of other files")
    bundle = json.loads((tmp_path / "all.sig").read_text())
    statement = base64.b64decode(bundle["dsseEnvelope"]["payload"]).replace(b"cartpole/2", b"cartpole/9")
    bundle["dsseEnvelope"]["payload"] = base64.b64encode(statement).decode()
    pathlib.Path(f"{first}.sig").write_text(json.dumps(bundle))
    is_refused("expected a bundle by one of the 1 keys")
    pathlib.Path(f"{first}.sig").write_text("{" + " " * 70000 + "}")
    is_refused("expected at most 65536 bytes")
    pathlib.Path(f"{first}.sig").write_text("{" + " " * 70 + "}")
    is_refused("bundle/dsseEnvelope/payloadType: expected application/vnd.in-toto+json")
