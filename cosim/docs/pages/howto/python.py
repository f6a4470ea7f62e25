# %% [markdown]
# # Analyse in Python
#
# This page is a notebook in plain Python, `cosim/docs/pages/howto/python.py`. Editors show its cells. It works with any
# run folder. This command makes one: `cosim run --set traffic.duration_s=60 --out runs/mine`.

# %%
from pathlib import Path

from cosim import Simulation, open_run
from results.figures.style import save

run = open_run("runs/mine")
print(run)

# %% [markdown]
# ## Tables are DataFrames
#
# A table is read when you ask for it. `run.table` reads only some columns.

# %%
vehicles = run.vehicles
print(vehicles.groupby(["vehicle_class", "equipped"], observed=True).size().unstack(fill_value=0))

speeds = run.table("actors", ["step", "actor", "speed_mps"])
print(f"mean speed {3.6 * speeds.speed_mps.mean():.1f} km/h")

# %% [markdown]
# `run.sql` asks the tables a question in SQL (DuckDB) and reads only what it needs. Beside the tables there is
# `subjects`: pseudonyms with the role of their vehicle. `$dt_s`, `$steps` and `$variant` stand for values of the run.

# %%
print(run.sql("SELECT step * $dt_s AS time_s, avg(speed_mps) AS mean_mps FROM actors GROUP BY 1 LIMIT 5"))

# %% [markdown]
# ## Who meets whom, and for how long
#
# Encounters that were under way when recording began or ended are censored, so the mean of the recorded durations is
# too short. The Kaplan-Meier estimator corrects for this.

# %%
print(run.measure.encounters.summary())
survival = run.measure.encounters.survival()
print(survival.head())

# %% [markdown]
# ## Does trust tell attackers apart?
#
# `subjects` joins pseudonyms with vehicles. This is ground truth, which no vehicle knows. `variant_table`
# reads one trust variant.

# %%
trust = run.variant_table("trust")
trust = trust[trust.n_evaluations > 0].merge(run.subjects, left_on="subject", right_index=True)
last = trust.sort_values("step").groupby("subject").tail(1)
print(last.groupby("role", observed=True).trust.describe()[["count", "25%", "50%", "75%"]])

honest, malicious = (last.trust[last.role == role].to_numpy() for role in ("honest", "malicious"))
if len(honest) and len(malicious):
    above = (honest[:, None] > malicious).mean() + 0.5 * (honest[:, None] == malicious).mean()
    print(f"an honest value is above a malicious one in {100 * above:.0f} % of pairs")

# %% [markdown]
# ## How old is the trust that is used?

# %%
lookups = run.variant_table("trust_lookups")
print(lookups.groupby("state", observed=True).newest_evaluation_age_s.describe()[["count", "50%", "max"]])
print(lookups.state.value_counts(normalize=True).round(3).to_dict())

# %% [markdown]
# ## Everything at once, and a figure

# %%
metrics = run.measure()
print(metrics[metrics.metric.str.startswith("freshness.")][["metric", "group", "value", "unit"]].head(12))
save(run.measure.trust.plot(), Path("trust.svg"))

# %% [markdown]
# ## Step by step, without a folder
#
# A `Simulation` gives the point clouds, detections, messages, trust and fused objects of each step. Its config is a
# dictionary or the path of a TOML file. Without a config, it simulates the default city. `trust=MyModel` uses your own
# class as the trust model. `detector`, `radio`, `pseudonyms` and `driver` work in the same way. Simulations may exist
# beside each other: SUMO runs in a process of its own for each.

# %%
with Simulation({"traffic": {"duration_s": 3}}) as simulation:
    for result in simulation:
        vehicle = result.sensing[0]
        cloud = result.cloud(vehicle)
        print(f"{result.time_s:.1f} s: {len(result.world)} actors, {len(cloud)} points of vehicle {vehicle},")
        print(
            f"  {len(result.detections)} detections, {len(result.messages)} messages, {len(result.fused)} fused objects"
        )
