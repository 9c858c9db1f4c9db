// The charts of the report. Data and plotly.js stand in the page, packed; nothing is fetched.
(async () => {
  const unpacked = async (id) => {
    const bytes = Uint8Array.from(atob(document.getElementById(id).textContent.trim()), (c) => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  if (!("DecompressionStream" in window)) {
    document.querySelectorAll(".chart").forEach((div) => { div.textContent = "This browser is too old for the charts."; });
    return;
  }
  const data = JSON.parse(await unpacked("data"));
  const script = document.createElement("script");
  script.textContent = await unpacked("plotly");
  document.head.append(script);

  const narrow = window.innerWidth < 700, ink = "#222222", rule = "#D9D9D9";
  const axis = (title) => ({ title: { text: title }, gridcolor: rule, zeroline: false });
  const logarithmic = (title, dtick) => ({ ...axis(`${title}, log`), type: "log", dtick, tickformat: "~g" });
  const layout = (x, y, more) => ({
    font: { family: "system-ui, sans-serif", size: narrow ? 11 : 13, color: ink },
    margin: { l: narrow ? 52 : 64, r: 10, t: 10, b: 44 },
    height: narrow ? 460 : 480,
    xaxis: x, yaxis: y, hovermode: "closest",
    legend: { orientation: "h", y: narrow ? -0.3 : -0.2, font: { size: narrow ? 10 : 12 } },
    paper_bgcolor: "#ffffff", plot_bgcolor: "#ffffff", ...more,
  });
  const config = { responsive: true, displaylogo: false, displayModeBar: narrow ? false : "hover" };
  const dashes = ["solid", "dash", "dot", "dashdot"];
  const look = (i) => ({ color: data.colours[i % data.colours.length], dash: dashes[Math.floor(i / data.colours.length) % 4] });
  const shown = (i) => (i < data.shown ? true : "legendonly");

  const choice = (id, names, change) => {
    const select = document.getElementById(id);
    names.forEach((name, i) => select.append(new Option(name, i)));
    select.addEventListener("change", change);
    return () => Number(select.value);
  };

  const draw = {
    errors: (curves, i, group) => [
      { y: curves.error, name: group, line: { ...look(i), width: 1.5 } },
      { y: curves.std, name: `${group}, 3 std. deviations claimed`, line: { ...look(i), width: 1, dash: "dot" }, showlegend: false },
    ],
    consistency: (curves, i, group) => [{ y: curves.nees, name: group, line: { ...look(i), width: 1.5 } }],
  };
  const overTime = (kind, y, extra) => {
    const redraw = () => {
      const variant = data.variants[variantOf()], vehicle = vehicleOf(), traces = [];
      data.observers.forEach((name, i) => {
        const curves = variant.curves[name];
        if (!curves) return;
        const own = { error: curves.error[vehicle], std: curves.std[vehicle], nees: curves.nees[vehicle] };
        draw[kind](own, i, name).forEach((trace) => {
          if (trace.y.some((value) => value !== null)) {
            traces.push({ x: variant.t, mode: "lines", legendgroup: name, visible: shown(i), hovertemplate: `%{y:.3g} at %{x:.4g} s<extra>${name}</extra>`, ...trace });
          }
        });
      });
      Plotly.react(`${kind}-chart`, [...traces, ...extra(variant, vehicle)], layout(axis("time [s]"), logarithmic(y, 1), {
        shapes: kind === "consistency" ? [{ type: "rect", xref: "paper", x0: 0, x1: 1, y0: data.band[0], y1: data.band[1], fillcolor: "#DCEAF6", line: { width: 0 }, layer: "below" }] : [],
      }), config);
    };
    const variantOf = choice(`${kind}-variant`, data.variants.map((v) => v.name), redraw);
    const vehicleOf = choice(`${kind}-vehicle`, data.vehicles, redraw);
    document.getElementById(`${kind}-vehicle`).value = data.first;
    redraw();
  };
  overTime("errors", "position error [m]", (variant, vehicle) => (variant.bound[vehicle].some((v) => v !== null)
    ? [{ x: variant.t, y: variant.bound[vehicle], mode: "lines", name: "Cramér-Rao bound (joint)", line: { color: ink, width: 1, dash: "dash" } }] : []));
  overTime("consistency", `NEES / ${data.dof}`, () => []);
  Plotly.newPlot("cost-chart", data.cost.map((point, i) => ({
    x: [point.us], y: [point.rmse], name: point.observer, mode: narrow ? "markers" : "markers+text", text: [point.observer],
    textposition: "top center", cliponaxis: false, showlegend: narrow,
    error_y: { type: "data", array: [point.se ?? 0], visible: point.se !== null, thickness: 1 },
    marker: { size: point.size, color: look(i).color, opacity: 0.75 },
    hovertemplate: `${point.observer}<br>%{x:.3g} µs, %{y:.3g} m, ${point.bytes} bytes/s<extra></extra>`,
  })), layout(logarithmic("time per update [µs]", "D2"), logarithmic("mean position RMSE [m]", "D2")), config);
  document.body.dataset.charts = "drawn";
})();
