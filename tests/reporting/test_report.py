from __future__ import annotations

import numpy as np
import pytest

import seaopt as so


def test_text_from_problems_is_escaped(stand, thor, tmp_path, without_drawing):
    controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30))
    told: list[tuple[str, int, int]] = []
    title = "<script>alert(1)</script>"
    page = so.write_report([controller], tmp_path / "r.html", title=title, progress=lambda *each: told.append(each))
    assert told == [("loop", 1, 1)]
    text = page.read_text(encoding="utf-8")
    assert "<script>" not in text
    assert "&lt;script&gt;" in text


def test_nothing_or_two_of_a_kind_is_refused(stand, thor, tmp_path, without_drawing):
    with pytest.raises(so.SeaoptError, match="no result"):
        so.write_report([], tmp_path / "r.html")
    controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30))
    with pytest.raises(so.SeaoptError, match="2 results of kind Controller"):
        so.write_report([controller, controller], tmp_path / "r.html")
    assert not list(tmp_path.iterdir())


def test_the_page_says_how_the_papers_form_compares_with_the_fit(stand, stand_log, thor, tmp_path, without_drawing):
    fit = so.fit([so.Experiment(plant=stand, log=stand_log, name="chirp", outputs=("F1",))], thor.free("J", "b_r"))
    page = so.write_report([fit], tmp_path / "r.html").read_text(encoding="utf-8")
    (said,) = [line for line in page.splitlines() if "Read as (16) with k known, F1/I gives" in line]
    mass = float(said.split("gives m_k = ")[1].split()[0])
    assert mass == pytest.approx(0.646 + 3.31e-6 / (0.002 / (6 * 3.141592653589793)) ** 2, rel=5e-4)  # (1), (2)
    assert "not of second order" not in said
    assert (tmp_path / "figures" / "response_chirp.svg").exists()


def test_a_log_with_gaps_and_missing_samples_is_drawn(stand, short_log, thor, tmp_path):
    import numpy as np

    keep = np.r_[0:3000, 4000:8000]
    force = short_log["F1"][keep].copy()
    force[100:110] = np.nan
    log = so.Log.from_arrays(time=short_log.time[keep], I=short_log["I"][keep], F1=force)
    fit = so.fit([so.Experiment(plant=stand, log=log, name="gappy")], thor.free("J"))
    so.write_report([fit], tmp_path / "r.html")
    assert (tmp_path / "figures" / "time_gappy.png").stat().st_size > 5000


def test_a_fit_has_diagnostics_and_a_ranking_says_why(stand, short_log, thor, tmp_path, without_drawing):
    fits = {
        drive: so.fit(
            [so.Experiment(plant=so.plants.high_impedance(drive=drive), log=short_log, name="chirp", outputs=("F2",))],
            thor.free("J", "b_r"), holdout=0.2,
        )
        for drive in ("unlumped", "lumped")
    }  # fmt: skip
    ranking = so.compare(fits)
    page = so.write_report([fits["lumped"], ranking], tmp_path / "r.html").read_text(encoding="utf-8")
    assert "chirp.F2: the residual follows I" in page
    assert "unlumped is preferred, with very strong evidence against lumped" in page
    for name in ("residual_chirp", "ranking"):
        assert (tmp_path / "figures" / f"{name}.svg").exists()
    alone = so.write_report([ranking], tmp_path / "alone.html").read_text(encoding="utf-8")
    assert "Which model" in alone and "Parameters" not in alone


def test_findings_of_a_fit_stand_in_the_report(stand, short_log, thor, tmp_path, without_drawing):
    swapped = so.Log.from_arrays(time=short_log.time, I=short_log["I"], F1=short_log["F2"], F2=short_log["F1"])
    bench = so.Experiment(plant=stand, log=swapped, name="chirp", outputs=("F1", "F2"))
    fit = so.fit([bench], thor.free("J", "b_r"))
    assert fit.errors
    read = so.Fit.from_dict(fit.to_dict(), (bench,))  # a report of a stored fit says the same
    for number, each in enumerate((fit, read)):
        page = so.write_report([each], tmp_path / f"{number}.html").read_text(encoding="utf-8")
        section = page.split("<h2>Findings</h2>")[1].split("</ul>")[0]
        assert section.count("<li") == len(fit.findings)
        assert section.count("<b>error</b>") == len(fit.errors)
        assert "F1 and F2 are swapped" in section
        for text in (page, repr(each)):  # beside the standard deviations
            assert text.lower().count("hold only if the model is right") == 1
    clean = so.fit([so.Experiment(plant=stand, log=short_log, outputs=("F1",))], thor.free("J"))
    assert not clean.findings
    page = so.write_report([clean], tmp_path / "clean.html").read_text(encoding="utf-8")
    assert "Findings" not in page
    assert not clean.caveat and "only if the model is right" not in page + repr(clean)


def test_a_fit_from_a_file_has_no_diagnostics(stand, short_log, thor, tmp_path, without_drawing):
    """They need residuals and the problem, which fit.json does not hold."""
    bench = so.Experiment(plant=stand, log=short_log, name="chirp", outputs=("F1",))
    read = so.Fit.from_dict(so.fit([bench], thor.free("J")).to_dict(), (bench,))
    page = so.write_report([read], tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Measured against model" in page and "Diagnostics" not in page


def test_what_was_done_to_the_data_stands_in_the_report(stand, thor, short_log, tmp_path, without_drawing):
    limit = 0.6 * np.max(np.abs(short_log["F1"]))
    experiment = so.Experiment(plant=stand, log=short_log, outputs=("F1",), saturation={"F1": (-limit, limit)})
    fit = so.fit([experiment], thor.free("J", "b_r"))
    page = so.write_report([fit], tmp_path / "report.html").read_text(encoding="utf-8")
    assert "at or beyond its declared range" in page
