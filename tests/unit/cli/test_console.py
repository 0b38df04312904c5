"""Progress where nobody looks at a terminal: in log files and pipes."""

from lanenet.cli.shared import console


def test_a_log_gets_a_line_at_once_now_and_then_and_at_the_end(capsys, monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr("lanenet.cli.shared.console.time.monotonic", lambda: now_s[0])
    with console.progress_bar("map") as progress:
        for done in range(1, 61):
            now_s[0] += 1.0
            progress("edges", done, 60)
        progress("lines", 1, 2)
    told = capsys.readouterr().err.splitlines()
    assert told == [
        "map: edges: 1 of 60",
        "map: edges: 21 of 60",
        "map: edges: 41 of 60",
        "map: edges: 60 of 60",
        "map: lines: 1 of 2",
    ]


def test_a_log_of_a_training_has_its_errors(capsys):
    with console.training_bar() as progress:
        progress(1, 1, 2.5, 1.25, 1500.0)
    assert capsys.readouterr().err == "train  RMSE 2.50 cm, validation 1.25 cm, 1500 samples/s: 1 of 1\n"
