"""Guided fuzzing by atheris: `python -m fuzz.run [TARGET ...] [--runs N] [--seconds S]`, as `make fuzz` does.

Each target runs in a process of its own with 1 GiB of memory and 5 s an input. What was found is in fuzz-out/TARGET;
inputs that led somewhere new are kept in fuzz-out/corpus/TARGET and are where the next run begins.
"""

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

MEMORY_MB = 1024  # of a process
HANG = 5  # seconds of one input
LONGEST = 64 * 1024  # bytes of an input


def main() -> int:
    """Fuzz each target and print a line for it; 1 where something was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", help="names of targets (default: all)")
    parser.add_argument("--runs", type=int, default=20_000, help="inputs a target (default: 20000)")
    parser.add_argument("--seconds", type=int, default=1800, help="longest time a target (default: 1800)")
    parser.add_argument("--out", type=Path, default=Path("fuzz-out"), help="folder (default: fuzz-out)")
    parser.add_argument("--list", action="store_true", help="print the names of the targets")
    parser.add_argument("--inside", help=argparse.SUPPRESS)
    args, rest = parser.parse_known_args()
    if args.inside:
        return inside(args.inside, args.out, rest)
    names = args.targets or _names()
    if args.list:
        print(*names, sep="\n")
        return 0
    failed = [name for name in names if not fuzzed(name, args)]
    print(
        f"{len(names) - len(failed)} of {len(names)} targets without a finding"
        + ("" if not failed else f"; found in {failed}")
    )
    return 1 if failed else 0


def _names() -> list[str]:
    """Names of the targets, from a process of its own, since nothing may be imported before it is instrumented."""
    command = [sys.executable, "-c", "from fuzz.targets import TARGETS; print(*TARGETS)"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()


def fuzzed(name: str, args: argparse.Namespace) -> bool:
    """Run one target; True if it ended without a finding."""
    out = args.out / name
    out.mkdir(parents=True, exist_ok=True)
    process = subprocess.run(
        [
            *(sys.executable, "-m", "fuzz.run", "--inside", name, "--out", str(args.out)),
            *(
                f"-runs={args.runs}",
                f"-max_total_time={args.seconds}",
                f"-rss_limit_mb={MEMORY_MB}",
                f"-timeout={HANG}",
            ),
            *(f"-max_len={LONGEST}", f"-artifact_prefix={out}/", "-print_final_stats=1"),
        ],
        capture_output=True,
        text=True,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
    )
    (out / "log.txt").write_text(process.stderr + process.stdout)
    done = re.findall(r"number_of_executed_units: (\d+)", process.stderr) or re.findall(
        r"^#(\d+)\s", process.stderr, re.M
    )
    covered = re.findall(r"cov: (\d+)", process.stderr)
    if not done:
        ended = f"DID NOT BEGIN, see {out}/log.txt"
    else:
        ended = "nothing found" if process.returncode == 0 else f"FOUND, see {out}"
    print(f"{name}: {done[-1] if done else 0} inputs, {covered[-1] if covered else 0} edges: {ended}", flush=True)
    return process.returncode == 0


def inside(name: str, out: Path, options: list[str]) -> int:
    """Fuzz one target in this process."""
    import atheris

    with atheris.instrument_imports(include=["coloc_graph", "rosbags", "tomllib", "yaml"]):
        from fuzz import seeds, targets

    from coloc_graph.errors import ColocError

    target = targets.TARGETS[name]
    corpus = out / "corpus" / name
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(seeds.seeds(name)):
        (corpus / f"seed-{number}").write_bytes(seed)

    def one(data: bytes) -> None:
        try:
            target(data)
        except ColocError as error:
            if "\n" in str(error) or len(str(error)) > 4000:
                raise AssertionError(f"not one sentence: {error}") from error

    atheris.Setup([sys.argv[0], *options, str(corpus)], one)
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
