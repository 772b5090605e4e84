import numpy as np

from tom.analysis.row_table import row_table
from tom.data.transitions import Transitions


def test_rows_count_the_whole_record_and_ages_the_rows_themselves():
    values = np.arange(12.0)
    ended = np.isin(values, [3, 9])
    obs = values[:, None]
    record = Transitions(obs, obs, values, obs + 1, ended, np.zeros(12, bool))
    table = row_table(record, np.ones(4), 11, (["x"], ["push"]))
    assert table["row"].tolist() == [7, 8, 9, 10]
    assert table["episode"].tolist() == [1, 1, 1, 2]
    assert table["episode_step"].tolist() == [3, 4, 5, 0]
    assert table["age"].tolist() == [12.5, 37.5, 62.5, 87.5]
    assert table["reward"].tolist() == [7, 8, 9, 10]
