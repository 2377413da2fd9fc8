"""Rehearse every recipe, and every conversion of a published original, at the published size.

What `make rehearse` runs. Each part has a process of its own and is stored when it has ended: the same
command resumes, and a part that was done with this version of the code is not run again. The tables of
docs/hardware.md are printed at the end. `--tiny` tries the script itself, in minutes.
"""

import argparse
import functools
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # results as JSON holds them

from vla_eval.storage.provenance import PACKAGE_FOLDER, checkout_state, cpu_model
from vla_eval.workers.children import python_command
from vla_eval.workers.start import child_context

GEMMA_EMBEDDINGS = 257_152 * 2_048  # lerobot's π0 family has them twice, a published file once
PALIGEMMA = 2_923_466_480 - (257_216 - 257_152) * 2_048  # of the published one, whose embeddings are padded
PUBLISHED: Mapping[str, int | None] = {
    "octo_small": 136_670_604,
    "octo_base": 92_830_092 + 109_628_544,
    "smolvla": 450_046_176,
    "openvla_oft": None,  # its head is not that of a published network
    "pi0_fast": PALIGEMMA + GEMMA_EMBEDDINGS,
    "spatialvla": 4_027_854_731,
    "pi0": 3_501_372_176 + GEMMA_EMBEDDINGS,
    "pi05": 3_616_757_520 + GEMMA_EMBEDDINGS,
}
"""Recipe -> parameters of the published network, see docs/hardware.md."""
OF_TINY_RECIPES = {
    "octo_small": "octo_tiny",
    "octo_base": "octo_tiny",
    "openvla_oft": "openvla_oft_tiny",
    "spatialvla": "spatialvla_tiny",
}
GRIPPER = ("--gripper", "unit_open")
ORIGINALS: Mapping[str, tuple[str, ...]] = {
    "octo-small": ("convert-octo", "--size", "small", *GRIPPER, "--tokenizer", "bytes"),
    "octo-base": ("convert-octo", "--size", "base", *GRIPPER, "--tokenizer", "bytes"),
    "spatialvla": ("convert-spatialvla",),
    "openvla": ("convert-openvla", "--image-aug", "no", *GRIPPER),
}
"""Published original -> arguments of `mikasa-vla checkpoint`."""
MEASURED = """
import sys
from vla_eval.cli.main import main
from vla_eval.testing.process_memory import peak_rss_bytes
assert main(["checkpoint", *sys.argv[1:]]) == 0
print(peak_rss_bytes())
"""
Result = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """How to rehearse.

    Attributes:
        folder: for files of a part; it is removed.
        tiny: tiny networks.
    """

    folder: Path
    tiny: bool


class CannotRunError(Exception):
    """A part cannot run as it was asked for; the message says why."""


def rehearse_recipe(name: str, options: Options) -> Result:
    """Write, load and run a recipe's policy on the CPU."""
    from vla_eval.testing.rehearsal import RehearsalOptions, rehearse

    has_own = options.tiny and name in OF_TINY_RECIPES
    recipe = OF_TINY_RECIPES[name] if has_own else name
    is_built_tiny = options.tiny and not has_own
    return rehearse(recipe, RehearsalOptions(folder=options.folder, tiny=is_built_tiny)).data()


def convert_original(name: str, options: Options) -> Result:
    """Write an original's names and shapes, and measure a process that only converts it."""
    if options.tiny:
        raise CannotRunError("--tiny writes no originals: tests convert tiny ones")
    from own_tests import find_tests

    find_tests()
    from tests.testing import published_originals as originals
    from vla_eval.checkpoints.files import WEIGHTS_FILE
    from vla_eval.testing.rehearsed import limit_bytes

    source, out = options.folder / "published", options.folder / "ours"
    source.mkdir(parents=True)
    writers: dict[str, Callable[[Path], None]] = {
        "octo-small": functools.partial(originals.write_octo, "small"),
        "octo-base": functools.partial(originals.write_octo, "base"),
        "spatialvla": originals.write_spatialvla,
        "openvla": originals.write_openvla,
    }
    writers[name](source)
    action, *flags = ORIGINALS[name]
    command = python_command("-c", MEASURED, action, str(source), "--out", str(out), *flags)
    started = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"the conversion ended with {done.returncode}: {done.stderr[-1500:]}")
    n_bytes = (out / WEIGHTS_FILE).stat().st_size
    return {
        "converted": name,
        "bytes": n_bytes,
        "seconds": time.perf_counter() - started,
        "peak_rss_bytes": int(done.stdout.splitlines()[-1]),
        "limit_bytes": limit_bytes(n_bytes),
    }


PARTS: Mapping[str, Callable[[Options], Result]] = {
    **{name: functools.partial(rehearse_recipe, name) for name in PUBLISHED},
    **{f"convert-{name}": functools.partial(convert_original, name) for name in ORIGINALS},
}


def main() -> int:
    """Run the parts that were not done with this version of the code; return 1 if one failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/rehearsal"), metavar="DIR")
    parser.add_argument("--part", nargs="+", choices=tuple(PARTS), default=tuple(PARTS), metavar="NAME")
    parser.add_argument("--tiny", action="store_true", help="tiny networks, to try the script")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    file = args.out / "rehearsal.json"
    records: dict[str, Any] = json.loads(file.read_text()) if file.is_file() else {}
    version = {**checkout_state(PACKAGE_FOLDER), "tiny": args.tiny}
    for name in args.part:
        if is_done(records.get(name), version):
            print(f"{name}: done before, with this version", file=sys.stderr)
            continue
        print(f"{name} …", file=sys.stderr, flush=True)
        records[name] = {
            "version": version,
            **run_part(name, Options(folder=args.out / "work", tiny=args.tiny)),
        }
        print(f"{name}: {records[name]['state']} in {records[name]['seconds']:.0f} s", file=sys.stderr)
        store(file, records)
    chosen = {name: records[name] for name in args.part}
    print("\n".join(lines(chosen)))
    return int(any(record["state"] == "failed" for record in chosen.values()))


def is_done(record: Mapping[str, Any] | None, version: Mapping[str, Any]) -> bool:
    """Whether a part has run with this version; without a commit, it is not known which one that was."""
    if record is None or version["commit"] is None:
        return False
    return record["version"] == version and record["state"] in ("done", "cannot run")


def run_part(name: str, options: Options) -> dict[str, Any]:
    """Run a part in a process of its own, so that its memory is its own, and check what it measured."""
    shutil.rmtree(options.folder, ignore_errors=True)  # of a call that was killed
    started = time.perf_counter()
    try:
        # What libraries print goes to standard error: standard output is the tables.
        to_stderr = {"initializer": os.dup2, "initargs": (2, 1)}
        with ProcessPoolExecutor(max_workers=1, mp_context=child_context(), **to_stderr) as executor:
            result = executor.submit(PARTS[name], options).result()
        wrong = problem(name, result, tiny=options.tiny)
        found: dict[str, Any] = {"state": "failed" if wrong else "done", "result": result}
        found |= {"why": wrong} if wrong else {}
    except CannotRunError as exc:
        found = {"state": "cannot run", "why": str(exc)}
    except Exception as exc:  # the next part may still be measured
        found = {"state": "failed", "why": f"{type(exc).__name__}: {exc!s:.2000}"}
    shutil.rmtree(options.folder, ignore_errors=True)
    return {**found, "seconds": time.perf_counter() - started}


def problem(name: str, result: Result, *, tiny: bool) -> str | None:
    """Return what is wrong with a result, if anything."""
    published = PUBLISHED.get(name)
    if not tiny and published is not None and result["parameters"] != published:
        return (
            f"expected the {published:,} parameters of the published network, found {result['parameters']:,}"
        )
    peaks = result["peak_rss_bytes"]
    highest = peaks if isinstance(peaks, int) else max(peaks["load"], peaks["act"])
    if highest > result["limit_bytes"]:
        return f"expected at most {result['limit_bytes']:,} bytes of memory, found {highest:,}"
    return None


def store(file: Path, records: Mapping[str, Any]) -> None:
    """Write the results so that an interruption leaves the old ones or the new ones."""
    temporary = file.with_suffix(".tmp")
    temporary.write_text(f"{json.dumps(records, indent=2)}\n")
    os.replace(temporary, file)


def lines(records: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the tables, when and where they were measured, and why a part has no result."""
    # Here and not above: tests import this file from elsewhere.
    from rehearsal_table import rehearsal_tables

    commits = sorted({_shown(record["version"]) for record in records.values()})
    tables = rehearsal_tables({name: x["result"] for name, x in records.items() if "result" in x})
    made = f"Measured {time.strftime('%Y-%m-%d', time.gmtime())} at {', '.join(commits)} on {cpu_model()}, "
    missing = [f"{name}: {x['state']}: {x['why']}" for name, x in records.items() if x["state"] != "done"]
    return [*tables, "", f"{made}{os.cpu_count()} cores.", *missing]


def _shown(version: Mapping[str, Any]) -> str:
    tiny = " with tiny networks" if version["tiny"] else ""
    return f"{str(version['commit'])[:7]}{' and changes' if version['changes'] else ''}{tiny}"


if __name__ == "__main__":
    raise SystemExit(main())
