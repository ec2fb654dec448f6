"""What an error says is one line of printable text, whatever it quotes."""

from coloc_graph.errors import TeamError


def test_a_message_is_one_line_without_control_characters():
    said = str(TeamError("team.toml: the name `a\r\n  b\x1b[31m\u202ec` is wrong"))
    assert said == "team.toml: the name `a b?[31m?c` is wrong"
    assert str(TeamError("Größe 3 µm")) == "Größe 3 µm"
