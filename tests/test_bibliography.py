import re
from pathlib import Path

from porrima.bibliography import bibliography, keys_of
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY


def test_a_paper_can_be_read_and_found():
    (paper,) = bibliography({"DucheneKraus2013", "NoSuchPaper1900"})
    assert paper.line.startswith("Duchêne & Kraus (2013). Stellar Multiplicity. Annual Review")
    assert paper.address == "https://doi.org/10.1146/annurev-astro-081710-102602"
    assert paper.bibtex.startswith("@article{DucheneKraus2013,")
    assert paper.bibtex.count("{") == paper.bibtex.count("}")


def test_no_mark_of_bibtex_is_left_in_any_line():
    text = "\n".join(one.bibtex for one in bibliography(everything()))
    assert len(re.findall(r"^@", text, re.M)) == len(everything())
    for paper in bibliography(everything()):
        assert not re.search(r"[\\{}$]|None", paper.line), paper.line


def test_a_model_tells_what_it_asks_to_be_cited():
    assert keys_of(MULTIPLICITY["dk13"]) == {"DucheneKraus2013", "KCM16"}
    assert keys_of(PHOTOMETRY["main-sequence"], PHOTOMETRY["habets-heintze"]) >= {"Bressan2012", "Habets1981"}
    assert {one.key for one in bibliography(keys_of(*MULTIPLICITY.values()))} == keys_of(
        *MULTIPLICITY.values()
    )


def everything():
    text = (Path(__file__).parents[1] / "docs" / "references.bib").read_text(encoding="utf-8")
    return set(re.findall(r"^@\w+\{(\w+),", text, re.M))
