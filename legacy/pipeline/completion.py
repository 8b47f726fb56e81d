"""Completion of the commands in a shell, made from the declared options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

SHELLS = ("bash", "zsh", "fish")


def completion(shell: str, flags: Mapping[str, Sequence[str]]) -> str:
    """Return the script that completes options, and file names elsewhere.

    Parameters
    ----------
    shell : {"bash", "zsh", "fish"}
    flags : mapping
        Options, or subcommands, by command.
    """
    if shell == "fish":
        lines = []
        for command, words in flags.items():
            for word in words:
                what = f"-l {word[2:]}" if word.startswith("--") else f"-a {word}"
                lines.append(f"complete -c {command} {what}")
        return "\n".join(lines) + "\n"
    lines = ["autoload -U +X bashcompinit && bashcompinit"] if shell == "zsh" else []
    for command, words in flags.items():
        lines += [
            f"_{command}() {{",
            f'  COMPREPLY=($(compgen -f -W "{" ".join(words)}" -- "${{COMP_WORDS[COMP_CWORD]}}"))',
            "}",
            f"complete -o filenames -F _{command} {command}",
        ]
    return "\n".join(lines) + "\n"
