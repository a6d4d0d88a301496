"""gaponet demo --real, on the public recordings."""

import json
from pathlib import Path

import pytest

from gaponet.cli.main import main


@pytest.mark.slow
def test_the_demo_identifies_the_real_arm_and_exports_it(sage_so101, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("GAPONET_DATA", str(sage_so101.parent))
    assert main(["demo", "--real", "--json", "--out", str(tmp_path / "demo")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["nominal_rad"] == pytest.approx(0.0192, abs=1e-4)
    assert result["identified_rad"] < 0.0035
    assert Path(result["picture"]).is_file()
    assert Path(result["export"]).is_file()


def test_the_demo_of_the_paper_says_what_it_needs(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("gaponet.cli.demo.find_spec", lambda name: None)
    assert main(["demo", "--out", str(tmp_path / "demo")]) == 2
    assert "[train]" in capsys.readouterr().err
