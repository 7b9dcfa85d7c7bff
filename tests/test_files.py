"""Files appear whole or not at all."""

from __future__ import annotations

import pytest
import torch

from ddco_pyro.files import read_tensors, whole_file, write_tensors, write_text


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_write_that_is_cut_off_leaves_what_was_there(tmp_path, error):
    path = tmp_path / "file.txt"
    write_text(path, "old")

    def write():
        with whole_file(path) as temporary:
            temporary.write_text("half of")
            raise error

    with pytest.raises(error):
        write()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_nobody_sees_a_file_before_it_is_whole(tmp_path):
    path = tmp_path / "deeper" / "file.txt"
    with whole_file(path) as temporary:
        temporary.write_text("half")
        assert not path.exists()
        temporary.write_text("whole")
    assert path.read_text() == "whole"
    assert list(path.parent.iterdir()) == [path]
    assert path.stat().st_mode & 0o777 == 0o644


def test_text_is_utf_8(tmp_path):
    write_text(tmp_path / "file", "σ = 0.1\n")
    assert (tmp_path / "file").read_bytes() == "σ = 0.1\n".encode()


def test_tensors_and_metadata_come_back_bit_for_bit(tmp_path):
    tensors = {
        "float": torch.randn(3, 4, generator=torch.Generator().manual_seed(0)),
        "double": torch.tensor([1 / 3, -torch.inf], dtype=torch.float64),
        "turned": torch.arange(6).reshape(2, 3).T,
    }
    write_tensors(tmp_path / "file", tensors, {"steps": "7"})
    found, metadata = read_tensors(tmp_path / "file")
    assert metadata == {"steps": "7"}
    assert set(found) == set(tensors)
    for name, value in tensors.items():
        torch.testing.assert_close(found[name], value, atol=0, rtol=0)


def test_equal_tensors_give_equal_files(tmp_path):
    metadata = {letter: f"{letter} σ" for letter in "abcdefgh"}
    for number in range(3):
        write_tensors(tmp_path / str(number), {"x": torch.ones(2), "y": torch.zeros(1)}, metadata)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1
    assert read_tensors(tmp_path / "0")[1] == metadata
