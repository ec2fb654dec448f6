"""An output has one writer, and nothing that others planted beside it is followed or overwritten."""

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from conformance_run import make

from coloc_graph.cli import main
from coloc_graph.errors import InputError, RunError
from coloc_graph.run import Motion, RunWriter, atomic_run, open_run
from coloc_graph.run.atomic_file import open_part, parts_left, write_atomically
from coloc_graph.run.output_lock import OutputLock, locked_output


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_planted_link_at_the_old_temporary_name_is_not_followed(tmp_path):
    victim = tmp_path / "victim.txt"
    victim.write_text("precious")
    (tmp_path / "out.mcap.part").symlink_to(victim)
    assert main(["simulate", "single-step", "--out", str(tmp_path / "out.mcap")]) == 0
    assert victim.read_text() == "precious"
    assert open_run(tmp_path / "out.mcap").stances


def test_a_planted_link_at_the_lock_or_the_run_is_not_followed(tmp_path):
    victim = tmp_path / "victim.txt"
    victim.write_text("precious")
    (tmp_path / ".locked.mcap.lock").symlink_to(victim)
    (tmp_path / "linked.mcap").symlink_to(victim)
    for name in ("locked.mcap", "linked.mcap"):
        with pytest.raises(RunError, match="link"):
            RunWriter(tmp_path / name, make.team())
    assert victim.read_text() == "precious"


def test_temporary_names_are_new_and_cannot_be_foreseen(tmp_path):
    first, second = (open_part(tmp_path / "run.mcap") for _ in range(2))
    for file, part in (first, second):
        assert stat.S_ISREG(os.fstat(file).st_mode)
        os.close(file)
        assert part.parent == tmp_path
    assert first[1] != second[1]
    (tmp_path / "run.mcap.notrandom.part").touch()
    (tmp_path / "other.run.mcap.0123456789abcdef.part").touch()
    assert parts_left(tmp_path / "run.mcap") == sorted([first[1], second[1]])


@pytest.mark.parametrize("second", [atomic_run, RunWriter])
@pytest.mark.parametrize("first", [atomic_run, RunWriter])
def test_the_second_writer_of_a_run_is_refused_and_harms_nothing(tmp_path, first, second):
    path = tmp_path / "run.mcap"
    with first(path, make.team()) as writer:
        writer.write(Motion("A", 1.0, True))
        # of the same thread too: only nested `locked_output` belong together
        with pytest.raises(InputError, match="is being written by another command; wait"):
            in_thread(lambda: second(path, make.team()).__enter__())
        writer.write(Motion("A", 2.0, False))
    assert len(list(open_run(path).motions("A"))) == 2
    assert names(tmp_path) == ["run.mcap"]
    with second(path, make.team()):  # once the first has ended
        pass


def in_thread(action):
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(action).result()


def test_of_two_commands_with_one_output_the_second_is_refused(tmp_path):
    out = tmp_path / "run.mcap"
    with locked_output(out):
        command = [sys.executable, "-m", "coloc_graph.cli", "simulate", "single-step", "--out", str(out)]
        process = subprocess.run(command, capture_output=True, text=True)
        assert process.returncode == 2
        assert process.stderr == (
            f"coloc: {out} is being written by another command; wait until it has ended, or give another path\n"
        )
    assert names(tmp_path) == []


def test_the_second_solve_into_a_folder_is_refused(tmp_path, capsys):
    run, out = tmp_path / "run.mcap", tmp_path / "new" / "result"
    assert main(["simulate", "single-step", "--out", str(run)]) == 0
    out.parent.mkdir()
    lock = OutputLock(out)
    assert main(["solve", str(run), "--out", str(out)]) == 2
    assert "is being written by another command" in capsys.readouterr().err
    lock.release()
    assert main(["solve", str(run), "--out", str(out)]) == 0
    assert names(out.parent) == ["result"]


def test_folders_that_were_made_for_a_lock_go_again(tmp_path):
    with pytest.raises(ZeroDivisionError), locked_output(tmp_path / "a" / "b" / "out"):
        raise ZeroDivisionError
    assert names(tmp_path) == []
    with locked_output(tmp_path / "a" / "out"):
        (tmp_path / "a" / "out").touch()
    assert names(tmp_path / "a") == ["out"]


def test_what_a_killed_command_wrote_is_said_and_can_be_read_and_does_not_lock(tmp_path, capsys):
    out = tmp_path / "run.mcap"
    code = (
        "import os, signal, sys; sys.path.insert(0, sys.argv[2])\n"
        "from conformance_run import make; from coloc_graph.run import Motion, atomic_run\n"
        "with atomic_run(sys.argv[1], make.team(), flush_every=None) as writer:\n"
        "    writer.write(Motion('A', 1.0, True))\n"
        "    writer._flush(); writer._file.flush(); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    here = str(Path(__file__).parents[1] / "support")
    process = subprocess.run([sys.executable, "-c", code, str(out), here], check=False, capture_output=True)
    assert process.returncode == -signal.SIGKILL
    (part,) = parts_left(out)
    assert len(list(open_run(part).motions("A"))) == 1
    assert main(["info", str(part)]) == 0
    capsys.readouterr()
    assert main(["simulate", "single-step", "--out", str(out)]) == 0
    assert f"warning: {part} was left by a killed command: read it with `coloc info`" in capsys.readouterr().err
    assert names(tmp_path) == ["run.mcap", part.name]


def test_a_file_that_is_replaced_keeps_its_rights_and_a_link_stays_one(tmp_path):
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    write_atomically(link, "new", synchronise=True)
    assert target.read_text() == "new" and link.is_symlink()
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    assert names(tmp_path) == ["link", "target"]
