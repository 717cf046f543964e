"use strict";
(() => {
  const root = document.documentElement;
  window.addEventListener("error", (event) => { root.dataset.error = event.message || "error"; });

  const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

  // One comparison: two of the frame's pictures on top of each other, with a divider and a zoom.
  function compare(frame) {
    const find = (selector) => frame.querySelector(selector);
    const stage = find(".stage"), range = find("input[type=range]"), zoom = find("[data-zoom]");
    const [under, over] = frame.querySelectorAll(".layer"), divider = find(".divider");
    const thumbs = [...frame.querySelectorAll(".picture")];
    const select = { left: find("[data-side=left]"), right: find("[data-side=right]") };
    const view = { scale: 1, x: 0.5, y: 0.5 }; // the picture's point, 0..1, in the middle of the stage

    for (const side of ["left", "right"]) {
      for (const thumb of thumbs) select[side].add(new Option(thumb.dataset.name, thumb.dataset.key));
      select[side].value = frame.dataset[side];
      select[side].addEventListener("change", show);
    }

    function show() {
      for (const [side, layer] of [["left", over], ["right", under]]) {
        const thumb = thumbs.find((t) => t.dataset.key === select[side].value);
        if (!thumb) continue;
        const source = thumb.querySelector("img");
        layer.firstElementChild.src = source.src;
        layer.firstElementChild.alt = source.alt;
        find(".tag." + side).textContent = thumb.dataset.name;
      }
      for (const thumb of thumbs) {
        const shown = thumb.dataset.key === select.left.value || thumb.dataset.key === select.right.value;
        thumb.setAttribute("aria-pressed", String(shown));
      }
    }

    function split(percent) {
      range.value = percent;
      move();
    }

    function move() {
      const percent = Number(range.value);
      over.style.clipPath = "inset(0 " + (100 - percent) + "% 0 0)";
      divider.style.left = percent + "%";
      range.setAttribute("aria-valuetext", Math.round(percent) + " % left picture");
    }

    function look(scale, x, y) {
      const half = 0.5 / scale;
      view.scale = scale;
      view.x = clamp(x, half, 1 - half);
      view.y = clamp(y, half, 1 - half);
      const left = (0.5 - view.x * scale) * 100, top = (0.5 - view.y * scale) * 100;
      for (const layer of [under, over])
        layer.firstElementChild.style.transform = "translate(" + left + "%," + top + "%) scale(" + scale + ")";
      stage.classList.toggle("zoomed", scale > 1);
      zoom.value = String(scale);
    }

    function place(event) {
      const box = stage.getBoundingClientRect();
      return { x: (event.clientX - box.left) / box.width, y: (event.clientY - box.top) / box.height, width: box.width };
    }

    let drag = null;
    stage.addEventListener("pointerdown", (event) => {
      if (event.button > 0) return;
      const at = place(event);
      const near = Math.abs(at.x - Number(range.value) / 100) * at.width < 28;
      drag = { id: event.pointerId, pan: view.scale > 1 && !near, x: at.x, y: at.y, from: { x: view.x, y: view.y } };
      try { stage.setPointerCapture(event.pointerId); } catch { /* not a pointer of this device */ }
      if (!drag.pan) split(clamp(at.x * 100, 0, 100));
    });
    stage.addEventListener("pointermove", (event) => {
      if (!drag || drag.id !== event.pointerId) return;
      const at = place(event);
      if (drag.pan) look(view.scale, drag.from.x - (at.x - drag.x) / view.scale, drag.from.y - (at.y - drag.y) / view.scale);
      else split(clamp(at.x * 100, 0, 100));
    });
    for (const kind of ["pointerup", "pointercancel"]) stage.addEventListener(kind, () => { drag = null; });
    stage.addEventListener("dblclick", (event) => {
      const at = place(event);
      if (view.scale > 1) look(1, 0.5, 0.5);
      else {
        look(4, at.x, at.y);
        split(clamp((0.5 + (at.x - view.x) * view.scale) * 100, 0, 100)); // the divider stays on the point
      }
    });
    stage.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      const steps = [...zoom.options].map((o) => Number(o.value));
      const at = steps.indexOf(view.scale);
      if (step && view.scale > 1) look(view.scale, view.x + 0.1 * step[0] / view.scale, view.y + 0.1 * step[1] / view.scale);
      else if (step && step[0]) split(clamp(Number(range.value) + 2 * step[0], 0, 100));
      else if (event.key === "+" || event.key === "=") look(steps[Math.min(at + 1, steps.length - 1)], view.x, view.y);
      else if (event.key === "-") look(steps[Math.max(at - 1, 0)], view.x, view.y);
      else return;
      event.preventDefault();
    });
    range.addEventListener("input", move);
    zoom.addEventListener("change", () => look(Number(zoom.value), view.x, view.y));
    find("[data-flip]").addEventListener("click", () => split(Number(range.value) > 50 ? 0 : 100));
    for (const thumb of thumbs) {
      thumb.title = "Show on the right";
      thumb.addEventListener("click", () => { select.right.value = thumb.dataset.key; show(); });
    }

    // The stage has the shape of the pictures and is never higher than the window.
    const first = over.firstElementChild;
    first.addEventListener("load", () => {
      const ratio = first.naturalWidth / first.naturalHeight || 16 / 9;
      const width = "min(100%, calc(82vh * " + ratio + "))";
      stage.style.aspectRatio = String(ratio);
      stage.style.width = range.parentElement.style.width = width;
    });
    stage.style.aspectRatio = "16 / 9";
    show();
    move();
    look(1, 0.5, 0.5);
    find(".compare").hidden = false;
    return { frame, stage, range, select, over, under, view };
  }

  function openTarget() {
    const target = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (target instanceof HTMLDetailsElement) { target.open = true; target.scrollIntoView(); }
  }

  // For tests: with the fragment #selftest the page drives its first slider and writes what it saw.
  function selfTest(view) {
    const seen = [];
    const state = () => seen.push(view.range.value + "|" + view.over.style.clipPath + "|" + view.under.firstElementChild.alt);
    const box = view.stage.getBoundingClientRect();
    const point = (kind, x) => view.stage.dispatchEvent(new PointerEvent(kind, {
      bubbles: true, pointerId: 1, clientX: box.left + x * box.width, clientY: box.top + box.height / 2,
    }));
    state();
    view.range.value = 20;
    view.range.dispatchEvent(new Event("input"));
    state();
    point("pointerdown", 0.6); point("pointermove", 0.8); point("pointerup", 0.8);
    state();
    view.stage.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft", bubbles: true }));
    state();
    view.frame.querySelector(".picture").click();
    state();
    view.stage.dispatchEvent(new MouseEvent("dblclick", { clientX: box.left + box.width / 2, clientY: box.top + box.height / 2 }));
    root.dataset.selftestZoom = String(view.view.scale);
    root.dataset.selftest = seen.join(";");
  }

  const views = [...document.querySelectorAll(".frame")].map(compare);
  window.addEventListener("hashchange", openTarget);
  openTarget();
  root.dataset.ready = String(views.length);
  if (location.hash === "#selftest") {
    root.dataset.selftestOverflow = String(root.scrollWidth - root.clientWidth);
    if (views.length) selfTest(views[0]);
  }
})();
