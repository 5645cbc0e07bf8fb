import dataclasses

import pytest

from unghost.data_recipes.recipe import Recipe, builtin_recipes, load_recipe, recipe_from_mapping


def test_builtin_recipes_load_under_their_own_names():
    assert {"procedural", "meshes", "csg"} <= set(builtin_recipes())
    for name in ("procedural", "meshes", "csg"):
        assert load_recipe(name).name == load_recipe(name).source == name


def test_a_file_reads_like_a_builtin(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('name = "mine"\nmax_dilation = 0\nsolid_share = 1\nfamilies = ["box", "ball"]\n', encoding="utf-8")
    recipe = load_recipe(path)
    assert (recipe.name, recipe.max_dilation, recipe.solid_share) == ("mine", 0, 1.0)
    assert recipe.families == ("box", "ball")


def test_an_unknown_key_without_a_near_one_gets_no_suggestion():
    with pytest.raises(ValueError, match=r"unknown keys \['zzz'\]; known: "):
        recipe_from_mapping({"zzz": 3})


def test_json_round_trip():
    recipe = load_recipe("meshes")
    assert recipe_from_mapping(recipe.to_dict()) == recipe


def test_unknown_key_is_refused_and_known_ones_are_listed():
    with pytest.raises(
        ValueError, match=r"unknown keys \['max_dilatation'\] \(did you mean max_dilation\?\); known: name"
    ):
        recipe_from_mapping({"max_dilatation": 3})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"edge_fraction": (0.2, 0.01)}, "edge_fraction must be"),
        ({"edge_fraction": (0.0, 0.1)}, "edge_fraction must be"),
        ({"edge_fraction": (0.1, 1.5)}, "edge_fraction must not exceed 1"),
        ({"severity": (0.0, 1.2)}, "severity must not exceed 1"),
        ({"severity": (0.1,)}, "severity must be two numbers"),
        ({"empty_share": 1.1}, r"empty_share must lie in \[0, 1\], got 1.1"),
        ({"on_share": 0.8, "near_share": 0.3}, "on_share"),
        ({"max_dilation": -1}, "max_dilation must be whole and >= 0"),
        ({"parts": (0, 3)}, "parts must be"),
        ({"source": "cad"}, "source must be one of procedural, meshes, csg, got 'cad'"),
        ({"split": "all"}, "split must be one of train, val, test"),
        ({"families": ("box", "bunny")}, r"unknown families \['bunny'\]; known: wall"),
        ({"families": ("box", "bal")}, r"unknown families \['bal'\] \(did you mean ball\?\); known: wall"),
        ({"severity_exponent": 0.0}, "severity_exponent"),
        (
            {"remesh_edge": 0.02},
            r"remesh_edge must be 0, or in \[0.001, 0.5\] where repair is true, got 0.02 with .* false",
        ),
        ({"repair": True, "remesh_edge": 0.6}, "remesh_edge must be 0, or in"),
    ],
)
def test_bad_values_name_the_key(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(Recipe(), **change)


def test_truth_values_are_read():
    assert recipe_from_mapping({"repair": True, "remesh_edge": 0.02}).repair is True
    for wrong in (1, "yes", 0.0):
        with pytest.raises(ValueError, match="repair must be bool"):
            recipe_from_mapping({"repair": wrong})


def test_wrong_types_are_refused():
    with pytest.raises(ValueError, match="max_dilation must be int"):
        recipe_from_mapping({"max_dilation": "two"})
    with pytest.raises(ValueError, match="solid_share must be float"):
        recipe_from_mapping({"solid_share": True})


def test_missing_and_broken_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"neither a file nor a built-in recipe \(did you mean procedural\?\)"):
        load_recipe("procedurall")
    path = tmp_path / "broken.toml"
    path.write_text("name = ", encoding="utf-8")
    with pytest.raises(ValueError, match="is not TOML"):
        load_recipe(path)
