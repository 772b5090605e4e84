from tom.config import flat, merged


def test_changes_come_on_top_group_by_group_and_leave_the_base_alone():
    base = {"sac": {"lr": 1, "tau": 2}, "steps": 3}
    assert merged(base, {"sac": {"lr": 9}}) == {"sac": {"lr": 9, "tau": 2}, "steps": 3}
    assert merged(base, {"steps": {"lr": 9}, "sac": None}) == {"sac": None, "steps": {"lr": 9}}
    assert base == {"sac": {"lr": 1, "tau": 2}, "steps": 3}


def test_values_by_dotted_path_at_any_depth():
    nested = {"seed": 1, "a": {"b": {"c": None}, "d": [2]}, "empty": {}}
    assert flat(nested) == {"seed": 1, "a.b.c": None, "a.d": [2]}
