from porrima.markdown import markdown_table, with_text_between


def test_a_table_has_a_line_for_the_heads_one_below_and_one_for_each_row():
    assert (
        markdown_table(["a", "b"], [["1", "2"], ["3", "4"]])
        == "| a | b |\n| --- | --- |\n| 1 | 2 |\n| 3 | 4 |"
    )


def test_text_between_markers_is_replaced_and_the_rest_stays():
    document = "before\n<begin>\nold\n<end>\nafter\n"
    assert (
        with_text_between(document, "<begin>", "<end>", r"a\1b")
        == "before\n<begin>\n\na\\1b\n\n<end>\nafter\n"
    )


def test_a_document_without_both_markers_stays_as_it_is():
    for document in ("nothing", "<begin> alone", "<end> before <begin>"):
        assert with_text_between(document, "<begin>", "<end>", "new") == document
