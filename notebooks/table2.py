# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Table II and Fig. 6: down the hallway
#
# The same leap-frog for 40 stances, more than seven metres. The paper compares the straight way that each robot made
# with a tape measure, in two cases. Here are a few stances, to be quick; `coloc experiment table2` goes all the way.

# %%
from IPython.display import SVG, display

from coloc_graph.experiments import draw, table2
from coloc_graph.report import figure_svg

result = table2(runs=2, stances=6, seed=0)
print(result.summary)

# %%
for row in [result.header, *result.rows]:
    print("".join(cell.rjust(16) for cell in row))

# %%
display(SVG(figure_svg(draw(result))))

# %% [markdown]
# The length hides most of the error of a chain: heading errors bend it to the side, which hardly changes how long it
# is. The end position tells, and there the difference between composing eq. (2) and a pose graph of maximum-likelihood
# poses is larger.

# %%
for name, label in (("eq2", "eq. (2)"), ("ours", "ours")):
    print(label, {key: round(value, 3) for key, value in result.rms(name).items()})
