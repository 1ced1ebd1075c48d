"""tools/with_vcan: a command runs where vcan0 and vcan1 are real, and comes back as if it had run here.

Whatever this machine offers is used, its own CAN or User-Mode Linux; one boot of the latter takes about two seconds, so
the facts are gathered in few runs. Where a run would need a network or another kernel, its tools are played by scripts.
"""

import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from pathlib import Path

import pytest

TOOL = Path(__file__).resolve().parent.parent / "tools" / "with_vcan"
ELSEWHERE = platform.system() != "Linux" or platform.machine() != "x86_64"

# Under CI a vcan that cannot be had is a failure, whatever the reason.
pytestmark = pytest.mark.skipif(ELSEWHERE and not os.environ.get("CI"), reason="vcan needs Linux on x86-64")

# A suite that was started in the background inherits an ignored SIGINT, and so would the commands here.
signal.signal(signal.SIGINT, signal.default_int_handler)

ODD = "two words, 'single' \"double\" $HOME `x` \\ and\na new line\t"


def environment(**changes):
    """This process's environment with changes; None removes."""
    env = {k: v for k, v in os.environ.items() if not k.startswith("VCAN_") or k == "VCAN_GUEST"}
    hidden = [p for p in (str(TOOL.parent), sys.prefix, sys.base_prefix) if p.startswith(("/tmp/", "/run/"))]
    env.update({"VCAN_RW": ":".join(hidden)} if hidden else {})  # a guest has a /tmp of its own
    env.update({k: str(v) for k, v in changes.items() if v is not None})
    for name in [k for k, v in changes.items() if v is None]:
        env.pop(name, None)
    return env


def run(*command, tool=TOOL, env=None, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options):
    options |= {"stdin": subprocess.DEVNULL, "stdout": stdout, "stderr": stderr}
    return subprocess.run([tool, *command], env=env or environment(), timeout=60, check=False, **options)


def program(path, text):
    path.write_text(textwrap.dedent(text).lstrip())
    path.chmod(0o755)
    return path


def processes(marker):
    """Command lines with the marker in them; a temporary directory's name makes them ours."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = entry.read_bytes()
        except OSError:
            continue  # gone meanwhile
        if os.fsencode(str(marker)) in line:
            found.append(line.replace(b"\0", b" ").decode(errors="replace"))
    return found


def left_behind(tmp, seconds=5.0):
    """Processes and files that a run with TMPDIR=tmp has left, after the given grace."""
    end = time.monotonic() + seconds
    while (left := processes(tmp) + sorted(map(str, tmp.iterdir()))) and time.monotonic() < end:
        time.sleep(0.05)
    return left


# ---------------------------------------------------------------- one run, many facts

PROBE = r"""
import json, os, pathlib, platform, socket, subprocess, sys
fact = {"argv": sys.argv[1:], "odd": os.environ.get("ODD"), "cwd": os.getcwd(), "uid": os.getuid(),
        "umask": os.umask(0), "kernel": platform.release(), "guest": os.environ.get("VCAN_GUEST"),
        "force": os.environ.get("VCAN_FORCE"), "stdin": os.readlink("/proc/self/fd/0"),
        "ttys": [os.isatty(n) for n in (0, 1, 2)], "types": {}, "received": {}, "other": {}}
os.umask(fact["umask"])
pathlib.Path("written").write_bytes(b"from inside\n" * 1000)
pathlib.Path(sys.argv[1], "also").write_text("x")
pathlib.Path("/tmp/with_vcan_probe").touch()

def can(name):
    s = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    s.bind((name,))
    s.settimeout(0.3)
    return s

frame = b"\x23\x01\0\0\x03\0\0\0abc\0\0\0\0\0"
for name, other in (("vcan0", "vcan1"), ("vcan1", "vcan0")):
    base = pathlib.Path("/sys/class/net", name)
    fact["types"][name] = [int((base / "type").read_text()), int((base / "flags").read_text(), 16) & 1]
    with can(name) as a, can(name) as b, can(other) as c:
        a.send(frame)
        fact["received"][name] = b.recv(72).hex()
        try:
            fact["other"][name] = c.recv(72).hex()
        except TimeoutError:
            fact["other"][name] = None

# Only a guest is ours to try the kernel's ways in for real: no interface of this machine is touched.
fact["ways"] = {}
if fact["guest"] and os.environ["TOOL"]:
    tool, root = [os.environ["TOOL"]], os.getuid() == 0
    ways = {"were up": [*tool], "created": ["unshare", "-n" if root else "-rn", *tool]}
    if root:
        user = ["setpriv", "--reuid", "65534", "--regid", "65534", "--clear-groups"]
        ways["in a network namespace of its own"] = ["unshare", "-n", *user, *tool]
    for way, command in ways.items():
        command += ["sh", "-c", "ip -o link show up; exit 6"]
        p = subprocess.run(command, cwd="/", capture_output=True, text=True)
        fact["ways"][way] = [p.returncode, p.stdout, p.stderr]

sys.stdout.write(json.dumps(fact) + "\n")
sys.stderr.write("first\nsecond, no end of line")
sys.stdout.flush()
sys.exit(7)
"""


@pytest.fixture(scope="module")
def probe(tmp_path_factory):
    cwd, also, tmp = (tmp_path_factory.mktemp(name) for name in ("a dir", "also", "tmp"))
    run("--", "true")  # a fresh machine fetches its kernel once, and says so in a line of its own
    (cwd / "probe.py").write_text(PROBE)
    umask = os.umask(0o027)
    try:
        env = environment(
            ODD=ODD,
            VCAN_RW=f"{also}:{environment().get('VCAN_RW', '')}",
            TMPDIR=tmp,
            TOOL=TOOL if shutil.which("ip") else "",
        )
        done = run("--", sys.executable, "probe.py", str(also), ODD, "", cwd=cwd, env=env)
    finally:
        os.umask(umask)
    assert done.returncode == 7, done.stderr.decode()
    return {"done": done, "fact": json.loads(done.stdout), "cwd": cwd, "also": also, "tmp": tmp}


def test_both_interfaces_are_up_and_speak_can(probe, capsys):
    fact = probe["fact"]
    with capsys.disabled():  # the log shall name what the vcan tests ran on
        print(f"\n[vcan: Linux {fact['kernel']}, interfaces {' '.join(fact['types'])}]", end=" ")
    assert fact["types"] == {"vcan0": [280, 1], "vcan1": [280, 1]}  # ARPHRD_CAN, IFF_UP
    assert fact["received"] == dict.fromkeys(("vcan0", "vcan1"), b"\x23\x01\0\0\x03\0\0\0abc\0\0\0\0\0".hex())
    assert fact["other"] == {"vcan0": None, "vcan1": None}, "two interfaces, not one"


def test_one_line_says_which_way_was_taken(probe):
    lines = probe["done"].stderr.decode().splitlines()
    assert lines[0].startswith(("with_vcan: kernel ", "with_vcan: User-Mode Linux "))
    assert probe["fact"]["kernel"] in lines[0]
    assert sum("with_vcan" in line for line in lines) == 1


def test_stdout_and_stderr_come_back_apart_and_unchanged(probe):
    out, err = probe["done"].stdout, probe["done"].stderr
    assert out == json.dumps(probe["fact"]).encode() + b"\n"
    assert err.split(b"\n", 1)[1] == b"first\nsecond, no end of line"
    assert probe["fact"]["ttys"] == [False] * 3
    assert probe["fact"]["stdin"] == "/dev/null"


def test_arguments_environment_directory_and_rights_arrive(probe):
    fact = probe["fact"]
    assert fact["argv"] == [str(probe["also"]), ODD, ""]
    assert fact["odd"] == ODD
    assert fact["cwd"] == str(probe["cwd"])
    assert fact["uid"] == os.getuid()
    assert fact["umask"] == 0o027


def test_files_written_inside_are_seen_here(probe):
    written = probe["cwd"] / "written"
    assert written.read_bytes() == b"from inside\n" * 1000
    assert written.stat().st_mode & 0o777 == 0o640, "the caller's umask"
    assert (probe["also"] / "also").read_text() == "x"
    if probe["fact"]["guest"] != os.environ.get("VCAN_GUEST"):
        assert not Path("/tmp/with_vcan_probe").exists(), "/tmp is the guest's own"
    assert left_behind(probe["tmp"]) == []


def test_the_kernels_own_ways(probe):
    """Tried inside the guest, whose kernel has CAN; on a machine with CAN the whole file runs that way."""
    if probe["fact"]["guest"] and shutil.which("ip"):
        assert probe["fact"]["ways"], "none tried"
    for way, (status, out, err) in probe["fact"]["ways"].items():
        assert err == f"with_vcan: kernel {probe['fact']['kernel']} vcan0 vcan1 ({way})\n"
        assert status == 6
        assert {"vcan0", "vcan1"} <= {line.split()[1].rstrip(":") for line in out.splitlines()}, way


# ---------------------------------------------------------------- how a command ends


def test_status_0_and_the_order_of_a_common_output(tmp_path):
    script = "i=0; while [ $i -lt 300 ]; do echo o$i; echo e$i >&2; i=$((i+1)); done"
    with (tmp_path / "log").open("wb") as log:
        done = run("sh", "-c", script, cwd=tmp_path, stdout=log, stderr=log)
    assert done.returncode == 0
    lines = (tmp_path / "log").read_text().splitlines()
    assert lines[1:] == [f"{stream}{i}" for i in range(300) for stream in "oe"]


@pytest.mark.parametrize(("script", "status"), [("exit 1", 1), ("kill -SEGV $$", 139)])
def test_status_of_a_failure_and_of_a_signal(tmp_path, script, status):
    # Through a shell, as a kernel's own CAN leaves us no process in between that could report 128+n.
    done = run("sh", "-c", f"sh -c '{script}'; exit $?", cwd=tmp_path)
    direct = run("sh", "-c", script, cwd=tmp_path) if status > 128 else done
    assert done.returncode == status
    assert direct.returncode in (status, 128 - status)


def test_killed_it_leaves_nothing(tmp_path):
    """By signals which the command hears of and may answer, also as a Ctrl-C to all of us, and by SIGKILL."""
    calls = {}
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGKILL):
        cwd, tmp = tmp_path / number.name, tmp_path / f"{number.name}-tmp"
        cwd.mkdir()
        tmp.mkdir()
        name = number.name.removeprefix("SIG")
        trap = "" if name == "KILL" else f'trap "echo heard; echo > heard; trap - {name}; kill -{name} $$" {name}; '
        calls[number] = cwd, tmp, subprocess.Popen(
            [TOOL, "sh", "-c", trap + "echo up; while :; do sleep 0.1; done"],
            cwd=cwd, env=environment(TMPDIR=tmp), stdout=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
    try:
        for number, (cwd, tmp, call) in calls.items():
            assert call.stdout.readline() == b"up\n"
            if list(tmp.iterdir()):  # so it is in a guest
                assert any("linux.uml" in line for line in processes(tmp)), "or this test would see nothing"
            (os.killpg if number == signal.SIGINT else os.kill)(call.pid, number)
            assert call.wait(15) == -number
            answer = b"" if number == signal.SIGKILL else b"heard\n"
            assert call.stdout.read() == answer
            assert left_behind(tmp) == []
            assert (cwd / "heard").exists() == bool(answer)
    finally:
        for _, _, call in calls.values():
            with call:
                call.kill()


def test_timeout(tmp_path):
    tmp = tmp_path / "tmp"
    tmp.mkdir()
    start = time.monotonic()
    done = run("sleep", "60", cwd=tmp_path, env=environment(VCAN_TIMEOUT="2.5", TMPDIR=tmp))
    assert done.returncode == 124
    assert 2.4 < time.monotonic() - start < 20
    assert len(done.stderr.decode().splitlines()) == 2, "which way, and that it timed out"
    assert "tim" in done.stderr.decode().splitlines()[1]
    assert left_behind(tmp) == []


def test_a_reader_who_leaves_ends_the_command(tmp_path):
    with subprocess.Popen(
        [TOOL, "yes"], cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as call:
        assert call.stdout.readline() == b"y\n"
        call.stdout.close()
        assert call.wait(20) in (-signal.SIGPIPE, 1), "1: yes itself, on a kernel with CAN and SIGPIPE ignored"


# ---------------------------------------------------------------- the processor

NUMBERS = r"""
import hashlib, os, signal, sys
import numpy as np

def digest():
    h, r = hashlib.sha256(), np.random.default_rng(5)
    a = r.standard_normal((120, 120))
    for _ in range(12):
        a = np.tanh(a @ a / 11 + 0.01)
        for b in (a, np.exp(a), np.sort(a, axis=None), a.astype(np.float32).cumsum(), a.copy()):
            h.update(b.tobytes())
    return h.hexdigest()

heard = [0]
def handler(*_):
    heard[0] += 1
if sys.argv[1:]:
    os.fork()  # two processes, that the registers change hands
    signal.signal(signal.SIGALRM, handler)
    signal.setitimer(signal.ITIMER_REAL, 0.002, 0.002)
digests = {digest() for _ in range(60 if sys.argv[1:] else 1)}
signal.setitimer(signal.ITIMER_REAL, 0)
os.write(1, f"{sorted(digests)} {heard[0] > 20}\n".encode())
if sys.argv[1:]:
    try:
        os.wait()
    except ChildProcessError:
        pass
"""


def test_vector_registers_survive_processes_and_signals(tmp_path):
    """The guest's kernel saves them its own way; the widest this processor and numpy have must come out right."""
    (tmp_path / "digests.py").write_text(NUMBERS)
    env = environment(OPENBLAS_NUM_THREADS="1")
    here = subprocess.run([sys.executable, "digests.py"], cwd=tmp_path, env=env, capture_output=True, check=True)
    done = run(sys.executable, "digests.py", "disturbed", cwd=tmp_path, env=env)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout.decode().splitlines() == [here.stdout.decode().split("]")[0] + "] True"] * 2


# ---------------------------------------------------------------- wrong usage


@pytest.mark.parametrize("arguments", [[], ["--"], ["--no-such-option", "true"]])
def test_without_a_command_it_says_how(arguments):
    done = run(*arguments)
    assert done.returncode == 125
    assert done.stdout == b""
    assert done.stderr.startswith(b"usage: tools/with_vcan")


def test_help_is_no_error():
    done = run("--help")
    assert (done.returncode, done.stderr) == (0, b"")
    for name in (b"VCAN_RW", b"VCAN_MEM", b"VCAN_TIMEOUT", b"VCAN_VERBOSE", b"VCAN_FORCE", b"PUMPBENCH_CACHE"):
        assert name in done.stdout


@pytest.mark.parametrize(("name", "value"), [("VCAN_FORCE", "magic"), ("VCAN_TIMEOUT", "soon"), ("VCAN_MEM", "plenty")])
def test_a_wrong_setting_is_named(name, value):
    done = run("true", env=environment(**{name: value}))
    assert done.returncode == 125
    assert done.stderr.startswith(f"with_vcan: {name}={value}: ".encode())


def test_candump_is_where_the_command_runs_and_cannot_be_written_to_there():
    done = run("sh", "-c", "command -v candump && test ! -w /run/can-utils && exec candump -T 1 vcan0")
    if done.returncode and b": kernel " in done.stderr and not os.environ.get("CI"):
        pytest.skip("a kernel with CAN of its own: apt-get install can-utils")
    assert (done.returncode, done.stdout[-8:]) == (0, b"candump\n"), done.stderr.decode()


def test_a_command_that_is_not_there():
    done = run("no-such-command-anywhere")
    assert done.returncode == 127
    assert done.stderr == b"with_vcan: no-such-command-anywhere: command not found\n"


# ---------------------------------------------------------------- where User-Mode Linux comes from: played


@pytest.fixture
def stage(tmp_path):
    """A PATH without linux.uml and apt-get, and an empty cache."""
    path = tmp_path / "bin"
    path.mkdir()
    tools = (
        "bash sh true cat mkdir mkfifo mktemp mv rm find grep tail readlink sleep touch chmod uname env python3 flock"
    )
    for name in tools.split():
        (path / name).symlink_to(sys.executable if name == "python3" else shutil.which(name))
    (tmp_path / "tmp").mkdir()
    places = {"PATH": path, "XDG_CACHE_HOME": tmp_path / "cache", "TMPDIR": tmp_path / "tmp", "STAGE": tmp_path}
    return (
        tmp_path,
        path,
        environment(VCAN_FORCE="uml", VCAN_MEM="64M", VCAN_GUEST=None, PUMPBENCH_CACHE=None, **places),
    )


def play_apt(path, *, known="true", can_utils="true"):
    """An apt-get that has a package if its word succeeds, a dpkg that unpacks it, and a kernel that panics at once."""
    program(
        path / "apt-get",
        f"""
        #!/bin/sh
        echo "$*" >> "$STAGE/apt.log"
        case "$*" in
          *" update") touch "$STAGE/updated" ;;
          *" download user-mode-linux") {known} || {{ echo "E: Unable to locate package user-mode-linux"; exit 100; }}
            touch user-mode-linux_1_amd64.deb ;;
          *" download can-utils") {can_utils} || {{ echo "E: Unable to locate package can-utils"; exit 100; }}
            touch can-utils_1_amd64.deb ;;
        esac
        """,
    )
    program(
        path / "dpkg",
        r"""
        #!/bin/sh
        [ "$1" = -x ] && [ -e "$2" ] && mkdir -p "$3/usr/bin" && sleep 0.2 || exit 2
        case "$2" in */can-utils_*) touch "$3/usr/bin/candump"; chmod +x "$3/usr/bin/candump"; exit ;; esac
        panic="echo booting; echo Kernel panic - not syncing: just played; echo Call Trace:; exit 134"
        printf '%s\n' '#!/bin/sh' '[ "$1" = --version ] && echo 1.2.3 && exit' "$panic" > "$3/usr/bin/linux.uml"
        chmod +x "$3/usr/bin/linux.uml"
        """,
    )


def cached(root):
    return sorted(p.name for p in (root / "cache" / "pumpbench").iterdir() if p.name != ".lock")


def test_without_apt_get_one_line_says_what_to_install(stage):
    root, _, env = stage
    done = run("true", env=env)
    assert done.returncode == 125
    lines = done.stderr.decode().splitlines()
    assert len(lines) == 1
    assert "apt-get" in lines[0]
    assert "install the Debian package user-mode-linux" in lines[0]
    assert not (root / "cache").exists()


def test_the_package_is_fetched_once_and_a_guest_that_dies_is_told(stage):
    root, path, env = stage
    play_apt(path)
    first, second = run("true", env=env), run("true", env=env)
    for done in first, second:
        assert done.returncode == 125
        assert done.stderr.decode().splitlines()[-1] == (
            "with_vcan: the guest died: Kernel panic - not syncing: just played"
        )
    assert b"fetching" in first.stderr
    assert b"fetching" not in second.stderr
    assert cached(root) == ["can-utils", "uml"]
    for package in ("user-mode-linux", "can-utils"):
        assert (root / "apt.log").read_text().count(f"download {package}") == 1
    assert left_behind(root / "tmp") == []


def test_without_package_lists_it_fetches_its_own(stage):
    root, path, env = stage
    play_apt(path, known='[ -e "$STAGE/updated" ]')
    run("true", env=env)
    download, update, again, _can_utils = (root / "apt.log").read_text().splitlines()
    assert "Dir::State::Lists" not in download, "the machine's lists first"
    for call in update, again:
        assert f"Dir::State::Lists={root}/cache/pumpbench/.fetch." in call, "never the machine's lists"
    assert cached(root) == ["can-utils", "uml"]


def test_without_can_utils_it_runs_all_the_same_and_does_not_ask_again_at_once(stage):
    root, path, env = stage
    play_apt(path, can_utils="false")
    first, second = (run("true", env=env).stderr.decode().splitlines() for _ in range(2))
    assert "with_vcan: cannot fetch can-utils: E: Unable to locate package can-utils: no candump in the guest" in first
    assert second[-1] == first[-1] == "with_vcan: the guest died: Kernel panic - not syncing: just played"
    assert not any("can-utils" in line for line in second)
    assert cached(root) == [".no-can-utils", "uml"]
    os.utime(root / "cache/pumpbench/.no-can-utils", (0, 0))
    play_apt(path)
    assert b"fetching the Debian package can-utils" in run("true", env=env).stderr
    assert (root / "cache/pumpbench/can-utils/usr/bin/candump").exists()


def test_a_package_that_cannot_be_fetched_is_told_and_leaves_nothing(stage):
    root, path, env = stage
    play_apt(path, known="false")
    done = run("true", env=env)
    assert done.returncode == 125
    assert done.stderr.decode().splitlines()[1:] == [
        "with_vcan: cannot fetch user-mode-linux: E: Unable to locate package user-mode-linux"
    ]
    assert cached(root) == []


def test_two_fetches_at_once_and_one_that_was_interrupted_before(stage):
    root, path, env = stage
    play_apt(path)
    (root / "cache" / "pumpbench" / "uml" / "usr").mkdir(parents=True)  # half a package
    calls = [subprocess.Popen([TOOL, "true"], env=env, stderr=subprocess.PIPE) for _ in range(2)]
    for call in calls:
        with call:
            assert call.stderr.read().decode().splitlines()[-1].endswith("just played")
    assert cached(root) == ["can-utils", "uml"]
    for package in ("user-mode-linux", "can-utils"):
        fetched = (root / "apt.log").read_text().count(f"download {package}")
        assert fetched == 1, "the second finds what the first has fetched"
    assert not (root / "cache/pumpbench/uml/root").exists(), "not one inside the other"


def test_killed_while_fetching_leaves_nothing(stage):
    root, path, env = stage
    play_apt(path, known=f"exec sleep 98765.{os.getpid()}")
    with subprocess.Popen([TOOL, "true"], env=env, stderr=subprocess.PIPE) as call:
        end = time.monotonic() + 10
        while not processes(f"98765.{os.getpid()}") and time.monotonic() < end:
            time.sleep(0.02)
        assert processes(f"98765.{os.getpid()}"), "never got to the download"
        call.terminate()
        assert call.wait(10) == -signal.SIGTERM
    assert processes(f"98765.{os.getpid()}") == []
    assert cached(root) == []


def test_the_cache_may_be_put_elsewhere(stage):
    root, path, env = stage
    play_apt(path)
    run("true", env=env | {"PUMPBENCH_CACHE": "here"}, cwd=root)
    assert (root / "here" / "uml" / "usr" / "bin" / "linux.uml").exists()
    assert not (root / "cache").exists()


# ---------------------------------------------------------------- the kernel's own CAN: played


def test_with_sudo_the_interfaces_are_made_for_everybody():
    """An `ip` that obeys only `sudo -n`. The caller must not be root, and so may not be able to read our tmp_path."""
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        root.chmod(0o777)
        tool = root / "with_vcan"
        shutil.copy(TOOL, tool)
        play = root / "bin"
        play.mkdir()
        program(
            play / "ip",
            f"""
            #!/bin/sh
            case "$*" in
              "-o link show dev "*" up") [ -e {root}/$5.up ] && echo "9: $5: <NOARP,UP> link/can" ;;
              "link show dev "*) [ -e {root}/$4 ] ;;
              "link add dev "*" type vcan") [ "$ROOT" ] && touch {root}/$4 ;;
              "link set dev "*" up") [ "$ROOT" ] && touch {root}/$4.up ;;
              *) exit 9 ;;
            esac
            """,
        )
        program(play / "sudo", '#!/bin/sh\n[ "$1" = -n ] || exit 1\nshift\nROOT=1 exec "$@"\n')
        program(play / "modprobe", f'#!/bin/sh\n[ "$ROOT" ] && echo "$*" >> {root}/modprobe.log\n')
        user = {"user": 65534, "group": 65534, "extra_groups": []} if os.getuid() == 0 else {}
        env = environment(PATH=f"{play}:{os.environ['PATH']}", VCAN_GUEST=None, VCAN_FORCE="kernel")
        ways = []
        for _ in range(2):
            done = run("sh", "-c", "exit 3", tool=tool, cwd="/", env=env, **user)
            assert done.returncode == 3, done.stderr.decode()
            ways.append(done.stderr.decode().split("vcan0 vcan1 ")[1])
        assert ways == ["(created with sudo)\n", "(were up)\n"]
        assert (root / "modprobe.log").read_text() == "vcan\n"


def test_forced_to_a_kernel_without_can_it_says_so(stage):
    _, path, env = stage  # no ip here, and a kernel cannot be asked without
    if not Path("/sys/class/net/vcan0").exists():
        done = run("true", env=env | {"VCAN_FORCE": "kernel"})
        assert done.returncode == 125
        assert done.stderr.decode().startswith("with_vcan: this kernel gives no vcan")
        assert len(done.stderr.splitlines()) == 1
    assert not (path / "ip").exists()
