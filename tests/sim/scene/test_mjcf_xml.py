"""A world's file is read as MuJoCo reads it, also where it is no XML by the standard."""

from __future__ import annotations

import random
from pathlib import Path

import mujoco
import pytest

from edqn_jax.sim.scene.mjcf import SceneError, load_world
from edqn_jax.sim.scene.mjcf_parts import xml as mjcf_xml

GEOM = '<geom name="block" type="box" pos="11 7 3" size="1 2 3"/>'
WORLD = f"""<mujoco>
  <worldbody>
    <site name="start" pos="2 2 3"/>
    <site name="goal" pos="20 12 4"/>
    <geom type="plane" size="0 0 1"/>
    {GEOM}
  </worldbody>
</mujoco>
"""


def named(name: str) -> str:
    return WORLD.replace("block", name)


def in_front(text: str) -> str:
    return text + WORLD


def within(text: str) -> str:
    return WORLD.replace("<worldbody>", text + "<worldbody>")


def with_geom(text: str) -> str:
    return WORLD.replace(GEOM, text)


READ = {
    "dashes in a comment": within("<!-- ----- a -- b --- -->"),
    "comment that looks like markup": within("<!-- <!DOCTYPE a> <geom & a=1 ]]> -->"),
    "comments around": in_front("<!-- -- -->") + "<!-- -- -->",
    "byte order mark": in_front("\ufeff"),
    "byte order mark and header": in_front('\ufeff<?xml version="1.0" encoding="utf-8"?>'),
    "XML 1.1": in_front('<?xml version="1.1" encoding="latin-1" standalone="no"?>'),
    "header after a line": in_front('\n  <?xml version="1.0"?>'),
    "two headers": in_front("<?xml?><?style a > b?>"),
    "doctype": in_front('<!DOCTYPE mujoco SYSTEM "a.dtd">'),
    "declaration inside": within("<!A>"),
    "cdata": within("<![CDATA[ <include/> & ]]>"),
    "text": within("a & b > c ]]> &foo; &#x;"),
    "text in front": in_front("hello"),
    "second element": WORLD + "<a/><b><c/></b>",
    "end of nothing": WORLD + "</a><b>",
    "ampersand": named("a & b"),
    "ampersand alone": named("&"),
    "unknown entities": named("a &foo; &LT; &#xZZ; &#x110000; &amp"),
    "entities": named("&lt;&amp;&quot;&apos;&gt;&#65;&#x41;"),
    "less than": named("a < b <c/> <!-- <?x?> <!DOCTYPE y>"),
    "greater than": named("a > b /> -->"),
    "quotes": with_geom("<geom name='a \"b\"' type=\"box\" pos='11 7 3' size='1 2 3'/>"),
    "both quotes": named("&quot;&apos;"),
    "control characters": named("a\x01b\x1f\x7f\x85\uffff"),
    "control characters between": within("\x01\x02\v\f<!-- \x03 -->"),
    "line in a name": named("a\n\tb"),
    "zero": named("a&#0;b"),
    "zero at the end": WORLD + "\0<a>",
    "no space between attributes": with_geom('<geom name="block"type="box"pos="11 7 3"size="1 2 3"/>'),
    "spaces everywhere": with_geom('< geom\vname\n=\f"block" type= "box" pos ="11 7 3" size="1 2 3" >< /geom >'),
    "line ends of Windows": WORLD.replace("\n", "\r\n"),
    "line ends of old Macs": WORLD.replace("\n", "\r"),
    "attribute of an end": WORLD.replace("</worldbody>", '</worldbody a="1">'),
    "namespace": WORLD.replace("<mujoco>", '<mujoco xmlns="http://a" xmlns:b="http://b">'),
    "model": WORLD.replace("<mujoco>", '<mujoco model="a & b">'),
}

REFUSED = {
    "empty": "",
    "blank": " \n",
    "text alone": "hello",
    "text at the end": WORLD + "hello",
    "less than in text": within("a < b"),
    "header after a comment": in_front("<!-- --><?xml?>"),
    "instruction inside": within("<?a?>"),
    "comment without end": within("<!-- <!- -- >"),
    "not closed": WORLD.replace("</mujoco>", ""),
    "closed by another": WORLD.replace("</worldbody>", "</worldbodi>"),
    "attribute twice": named('a" name="b'),
    "no quotes": with_geom('<geom name=block type="box" size="1 2 3"/>'),
    "no value": with_geom('<geom name type="box" size="1 2 3"/>'),
    "slash apart": with_geom('<geom type="box" size="1 2 3" / >'),
    "zero inside": named("a\0b"),
    "too deep": within("<worldbody>" + "<body>" * 600 + '<geom size="1"/>' + "</body>" * 600 + "</worldbody>"),
    "unknown element": within("<x:foo/>"),
    "other capitals": WORLD.replace("mujoco", "MUJOCO"),
}


def mujoco_names(file: Path) -> list[str]:
    model = mujoco.MjModel.from_xml_path(str(file))
    return [model.geom(i).name for i in range(model.ngeom)]


@pytest.mark.parametrize("text", READ.values(), ids=READ.keys())
def test_what_mujoco_reads_is_the_same_world(tmp_path: Path, text: str) -> None:
    file = tmp_path / "world.xml"
    file.write_bytes(text.encode())
    world = load_world(file)
    assert (world.scene.planes.position.shape, world.scene.boxes.half.tolist()) == ((1, 3), [[1.0, 2.0, 3.0]])
    assert ["", *world.names["boxes"]] == mujoco_names(file)


@pytest.mark.parametrize("text", REFUSED.values(), ids=REFUSED.keys())
def test_what_mujoco_does_not_read_is_refused_with_the_line(tmp_path: Path, text: str) -> None:
    file = tmp_path / "world.xml"
    file.write_bytes(text.encode())
    with pytest.raises(ValueError):
        mujoco_names(file)
    with pytest.raises(SceneError, match="world.xml is not an MJCF(:| that MuJoCo can read:)"):
        load_world(file)


@pytest.mark.parametrize("text", [named("Höhle"), within("<!-- Höhle -->")])
def test_a_file_in_latin_1_is_read_and_one_in_utf_16_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "world.xml"
    file.write_bytes(text.encode("latin-1"))
    assert load_world(file).names["boxes"] == ("Höhle" if "Höhle" in text.split("-->")[-1] else "block",)
    for encoding in ("utf-16", "utf-16-le", "utf-16-be", "utf-32"):
        file.write_bytes(text.encode(encoding))
        with pytest.raises(SceneError, match="it is UTF-16 or UTF-32 text; save it as UTF-8"):
            load_world(file)


def test_a_text_without_an_element_is_no_xml(tmp_path: Path) -> None:
    file = tmp_path / "world.xml"
    file.write_text("notes of a flight\n")
    with pytest.raises(SceneError, match="it is no XML: it has no element"):
        load_world(file)


def test_messages_name_the_line_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "world.xml"
    before = "<!-- a\n -- b\n -->"
    file.write_text(before + WORLD.replace('<geom type="plane"', '<geom\n type="plane"\n typo="1"'))
    with pytest.raises(SceneError, match="unrecognized attribute: 'typo' Element 'geom', line 7"):
        load_world(file)
    file.write_text(before + WORLD.replace("</worldbody>", "</body>"))
    with pytest.raises(SceneError, match="line 9: </body> closes <worldbody>"):
        load_world(file)


PIECES = [
    *(
        "<",
        ">",
        "/",
        '"',
        "'",
        "&",
        "&amp;",
        "&#65;",
        "&#x;",
        "&#0;",
        "--",
        "-->",
        "<!--",
        "<![CDATA[",
        "]]>",
        "<!",
        "<!A>",
    ),
    *(
        "<?",
        "?>",
        "<?xml?>",
        " ",
        "\n",
        "\r\n",
        "\t",
        "\x01",
        "\v",
        "=",
        ' a="1"',
        "</mujoco>",
        "</a>",
        "<a>",
        "<mujoco/>",
    ),
    *("é", ":", "<body>", "</body>", "\ufeff", 'name="q"', "\x1c", "\x85", "\u2028", "</geom/>"),
]


@pytest.mark.whole
@pytest.mark.slow
def test_of_files_with_pieces_put_in_mujoco_and_we_read_the_same_ones_alike(tmp_path: Path) -> None:
    drawn, file, read = random.Random(0), tmp_path / "world.xml", 0
    for _ in range(4000):
        text = WORLD
        for _ in range(drawn.randint(1, 3)):
            at = drawn.randrange(len(text) + 1)
            text = text[:at] + drawn.choice(PIECES) + text[at + drawn.choice([0, 0, 1]) :]
        file.write_bytes(text.encode())
        try:
            wanted = mujoco_names(file)
        except ValueError:
            wanted = None
        try:
            model = mujoco.MjModel.from_xml_string(mjcf_xml.parse_xml(text)[1])
            found = [model.geom(i).name for i in range(model.ngeom)]
        except mjcf_xml.SubsetError:
            continue
        except ValueError:
            found = None
        assert found == wanted, text
        read += found is not None
    assert read > 200
