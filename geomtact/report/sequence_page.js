const slider = document.getElementById("frame"), play = document.getElementById("play");
const element = id => document.getElementById(id);
let timer = null;
function show(i) {
  const f = FRAMES[i];
  slider.value = i;
  element("number").textContent = `frame ${f.frame} of ${FRAMES.length}`;
  for (const name of ["image", "contact"]) {
    element(name).style.visibility = f[name] ? "visible" : "hidden";
    if (f[name]) element(name).src = "data:image/png;base64," + f[name];
  }
  element("summary").textContent = f.summary;
  element("mark").setAttribute("x1", f.x);
  element("mark").setAttribute("x2", f.x);
  element("warnings").replaceChildren(...f.warnings.map(text => {
    const p = document.createElement("p");
    p.className = "warning";
    p.textContent = text;
    return p;
  }));
}
function stop() { clearInterval(timer); timer = null; play.textContent = "Play"; }
slider.oninput = () => { stop(); show(Number(slider.value)); };
play.onclick = () => {
  if (timer) return stop();
  if (Number(slider.value) === FRAMES.length - 1) show(0);
  play.textContent = "Pause";
  timer = setInterval(() => {
    const next = Number(slider.value) + 1;
    if (next < FRAMES.length) show(next); else stop();
  }, 300);
};
show(0);
