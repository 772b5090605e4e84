"""tests/FAULTS.md is what the tests say."""

from table import TABLE, sections, table, unnamed


def test_the_table_is_up_to_date():
    assert TABLE.read_text() == table(), "run: python tests/fault/table.py"


def test_every_fault_says_its_outcome_and_the_list_is_not_empty():
    assert unnamed() == []
    assert sum(len(faults) for _, _, faults in sections()) > 50
