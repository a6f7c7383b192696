from setuptools import setup

NAME = "spikeserve_ros"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/spikeserve.launch.py"]),
        (f"share/{NAME}/config", ["config/cartpole.yaml", "config/cartpole_joints.yaml"]),
    ],
    # The client `spikeserve` is a wheel of the same release: docs/guides/ros.md.
    install_requires=["setuptools", "PyYAML"],
    license="Apache-2.0",
    entry_points={"console_scripts": [f"node = {NAME}.node:main"]},
)
