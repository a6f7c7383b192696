"""Runs the services of deploy/compose/compose.yaml as processes of this machine, with the same configuration files.

Each service has its own network namespace with an address on one bridge, and its name in /etc/hosts. All of them see an
overlay of this machine's files, in which the files that compose.yaml mounts lie. Works only in a network and a mount
namespace of its own, as root; call `enter` first.
"""

import os
import pathlib
import shutil
import signal
import subprocess
import sys

import yaml

COMPOSE = pathlib.Path(__file__).parents[2] / "deploy/compose"
NETWORK = "10.89.0"
PASSWORD = "of-redis"
# What the images have as their environment; tests/python/deploy/test_image.py runs the real image.
IMAGE_ENVIRONMENT = {
    "SPIKESERVE_POLICIES": "/usr/share/spikeserve/policies",
    "SPIKESERVE_LISTEN": "0.0.0.0:50051",
    "SPIKESERVE_HTTP_LISTEN": "0.0.0.0:9464",
}


def enter(arguments):
    """Runs this program again, with `arguments`, in namespaces of its own, and returns its exit status."""
    command = ["unshare", "--net", "--mount", sys.executable, *arguments]
    return subprocess.run(command, env=os.environ | {"COMPOSE_NAMESPACE": "1"}).returncode


def run(*command):
    subprocess.run([*map(str, command)], check=True)


class Service:
    """A service of compose.yaml. Its namespace lives until `close`; its process may be killed and started again."""

    def __init__(self, name, number, command, environment, root):
        self.name = name
        self.address = f"{NETWORK}.{number}"
        self._command = command
        self._environment = environment
        self._root = root
        self._process = None
        holder = ["unshare", "--net", "sh", "-c", "echo; exec sleep infinity"]
        self._holder = subprocess.Popen(holder, stdout=subprocess.PIPE)
        self._holder.stdout.readline()  # the namespace exists
        run("ip", "link", "add", f"s{number}", "type", "veth", "peer", "name", "eth0", "netns", self._holder.pid)
        run("ip", "link", "set", f"s{number}", "master", "bridge0", "up")
        self._inside("ip", "address", "add", f"{self.address}/24", "dev", "eth0")
        for device in ("lo", "eth0"):
            self._inside("ip", "link", "set", device, "up")

    def _inside(self, *command):
        run("nsenter", "-t", self._holder.pid, "-n", *command)

    def start(self):
        enter_root = ["nsenter", "-t", str(self._holder.pid), "-n", "chroot", str(self._root)]
        self._process = subprocess.Popen(
            [*enter_root, *self._command], env=os.environ | self._environment, stdout=subprocess.DEVNULL
        )

    def kill(self):
        if self._process is not None:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()
            self._process = None

    def close(self):
        self.kill()
        self._holder.kill()
        self._holder.wait()
        self._holder.stdout.close()


class Layout:
    """All services whose programs are here. `programs` has the program of each image, without its tag."""

    def __init__(self, folder, programs, policies):
        self.compose = yaml.safe_load((COMPOSE / "compose.yaml").read_text())
        run("ip", "link", "set", "lo", "up")
        run("ip", "link", "add", "bridge0", "type", "bridge")
        run("ip", "address", "add", f"{NETWORK}.1/24", "dev", "bridge0")
        run("ip", "link", "set", "bridge0", "up")
        self._root = folder / "root"
        self._mount(folder)
        shipped = self._root / "usr/share/spikeserve"
        shipped.mkdir(parents=True, exist_ok=True)
        shutil.copytree(policies, shipped / "policies", dirs_exist_ok=True)
        self.services = {}
        for number, (name, described) in enumerate(self.compose["services"].items(), start=10):
            image = described["image"].rpartition(":")[0]
            if image in programs:
                self._place(described.get("volumes", []))
                self._keep_secrets(described.get("secrets", []))
                words = [word.replace("$$", "$") for word in described.get("command", [])]
                command = [*programs[image], *words]
                environment = IMAGE_ENVIRONMENT | described.get("environment", {})
                self.services[name] = Service(name, number, command, environment, self._root)
        hosts = "".join(f"{service.address} {name}\n" for name, service in self.services.items())
        (self._root / "etc/hosts").write_text("127.0.0.1 localhost\n" + hosts)
        for service in self.services.values():
            service.start()

    def _mount(self, folder):
        for name in ("upper", "work", "root"):
            (folder / name).mkdir()
        options = f"lowerdir=/,upperdir={folder}/upper,workdir={folder}/work"
        run("mount", "-t", "overlay", "overlay", "-o", options, self._root)
        for name in ("dev", "proc", "sys"):
            run("mount", "--rbind", f"/{name}", self._root / name)

    def _place(self, volumes):
        """Copies the files of `volumes` to where the containers see them, and makes the folders of named volumes."""
        for volume in volumes:
            source, target = volume.split(":")[:2]
            inside = self._root / target.lstrip("/")
            if source.startswith("."):
                inside.parent.mkdir(parents=True, exist_ok=True)
                path = COMPOSE / source
                shutil.copytree(path, inside, dirs_exist_ok=True) if path.is_dir() else shutil.copy(path, inside)
            else:
                inside.mkdir(parents=True, exist_ok=True)

    def _keep_secrets(self, names):
        """Writes PASSWORD as every secret, and a stand-in for the program of the image that gives up the rights of root."""
        for name in names:
            file = self._root / "run/secrets" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(PASSWORD + "\n")
        entry = self._root / "usr/local/bin/docker-entrypoint.sh"
        entry.write_text('#!/bin/sh\nexec "$@"\n')
        entry.chmod(0o755)

    def close(self):
        for service in self.services.values():
            service.close()
