"""Runs in the image and prints what is in it, as CycloneDX 1.5: Debian packages, Python distributions."""

import hashlib
import json
import platform
import subprocess
import uuid
from importlib.metadata import distributions
from urllib.parse import quote

Component = dict[str, str]


def debian_packages(distribution: str) -> list[Component]:
    listed = subprocess.run(
        ["dpkg-query", "-W", "-f", "${db:Status-Abbrev}\t${Package}\t${Version}\t${Architecture}\n"],
        check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    rows = [line.split("\t") for line in listed.splitlines()]
    return [
        component(
            name,
            version,
            f"pkg:deb/debian/{name}@{quote(version, safe='')}?arch={architecture}&distro={distribution}",
        )
        for status, name, version, architecture in rows
        if status.strip() == "ii"
    ]


def python_distributions() -> list[Component]:
    return [
        component(one.name, one.version, f"pkg:pypi/{one.name.lower().replace('_', '-')}@{one.version}")
        for one in distributions()
    ]


def component(name: str, version: str, purl: str) -> Component:
    return {"type": "library", "bom-ref": purl, "name": name, "version": version, "purl": purl}


def bill() -> dict[str, object]:
    system = platform.freedesktop_os_release()
    distribution = f"{system['ID']}-{system['VERSION_ID']}"
    parts = sorted(debian_packages(distribution) + python_distributions(), key=lambda part: part["purl"])
    ours = next(part for part in parts if part["name"] == "can-bridge")
    digest = hashlib.sha256(json.dumps(parts).encode()).digest()
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.5.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "serialNumber": f"urn:uuid:{uuid.UUID(bytes=digest[:16], version=4)}",
        "version": 1,
        "metadata": {"component": {**ours, "type": "container", "bom-ref": "image"}},
        "components": [
            {
                "type": "operating-system",
                "bom-ref": distribution,
                "name": system["ID"],
                "version": system["VERSION_ID"],
            },
            *parts,
        ],
    }


print(json.dumps(bill(), indent=1))
