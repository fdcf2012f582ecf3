// The object at each mode over the sensors' windows, turned by mouse, finger or keys. No library, no network.
(() => {
  "use strict";
  const root = document.getElementById("scene");
  const data = JSON.parse(document.getElementById("scene-data").textContent);
  const canvas = root.querySelector("canvas");
  const tabs = [...root.querySelectorAll("[role=tab]")];
  const shown = root.querySelector("input");
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: true, preserveDrawingBuffer: true });
  if (!gl) {
    root.hidden = true; // the pictures below show the same
    return;
  }

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const PART = [0.72, 0.75, 0.8], WINDOW = [0.0, 0.45, 0.7], OBSERVED = [0.835, 0.369, 0.0];

  const compiled = (vertex, fragment) => {
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, "#version 300 es\nprecision highp float;\n" + text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "point");
    gl.bindAttribLocation(program, 1, "weight");
    gl.linkProgram(program);
    return program;
  };

  // everything lies in the first sensor's frame, in millimetres; the view is without perspective
  const program = compiled(
    `in vec3 point; in float weight;
     uniform mat4 model; uniform mat3 view; uniform vec3 middle; uniform vec3 scale; uniform float size; uniform float lift;
     out vec3 at; out float share;
     void main() {
       at = view * ((model * vec4(point, 1.0)).xyz - middle);
       share = weight;
       gl_Position = vec4(at.xy * scale.xy, -(at.z + lift) * scale.z, 1.0);
       gl_PointSize = size;
     }`,
    `in vec3 at; in float share;
     uniform vec4 colour; uniform int kind;
     out vec4 pixel;
     void main() {
       pixel = colour;
       if (kind == 1) { // the object, each face lit as it lies
         vec3 normal = normalize(cross(dFdx(at), dFdy(at)));
         pixel.rgb *= 0.45 + 0.55 * abs(normal.z);
       } else if (kind == 2) { // where it may have been touched, from blue to yellow
         if (length(gl_PointCoord - 0.5) > 0.5 || share < 0.04) discard;
         pixel.rgb = mix(vec3(0.0, 0.45, 0.7), vec3(0.94, 0.89, 0.26), sqrt(share));
       }
     }`,
  );
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);

  const buffered = (array, target = gl.ARRAY_BUFFER) => {
    const buffer = gl.createBuffer();
    gl.bindBuffer(target, buffer);
    gl.bufferData(target, array, gl.STATIC_DRAW);
    return buffer;
  };
  const faces = new Uint32Array(bytes(data.faces));
  const points = new Float32Array(bytes(data.points));
  const buffers = {
    vertices: buffered(new Float32Array(bytes(data.vertices))),
    faces: buffered(faces, gl.ELEMENT_ARRAY_BUFFER),
    points: buffered(points),
    weights: buffered(new Float32Array(bytes(data.weights))),
    windows: data.windows.map((corners) => buffered(new Float32Array(corners.flat()))),
    outlines: data.outlines.map((line) => [buffered(new Float32Array(line.flat())), line.length]),
  };

  let mode = 0, turn = Math.atan2(-0.75, -0.45), rise = 0.52, zoom = 1;
  const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  const columns = (T) => [0, 1, 2, 3].flatMap((c) => [0, 1, 2, 3].map((r) => T[r][c]));

  const draw = () => {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    gl.viewport(0, 0, canvas.width, canvas.height);
    const page = getComputedStyle(document.body).backgroundColor.match(/[\d.]+/g).map((x) => x / 255);
    gl.clearColor(page[0], page[1], page[2], 1);
    gl.depthMask(true); // or the depths of the last picture stay
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);

    const [ct, st, cr, sr] = [Math.cos(turn), Math.sin(turn), Math.cos(rise), Math.sin(rise)];
    const back = [cr * ct, cr * st, sr], right = [-st, ct, 0];
    const up = [-sr * ct, -sr * st, cr];
    gl.uniformMatrix3fv(uniform("view"), false, [0, 1, 2].flatMap((i) => [right[i], up[i], back[i]]));
    gl.uniform3fv(uniform("middle"), data.middle);
    const size = zoom / data.radius, aspect = canvas.width / canvas.height;
    gl.uniform3f(uniform("scale"), size / Math.max(aspect, 1), size * Math.min(aspect, 1), 0.2 / data.reach);

    const put = (buffer, model, colour, kind, lift, how) => {
      gl.uniformMatrix4fv(uniform("model"), false, model);
      gl.uniform4f(uniform("colour"), ...colour);
      gl.uniform1i(uniform("kind"), kind);
      gl.uniform1f(uniform("lift"), lift);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(0);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
      how();
    };
    gl.disableVertexAttribArray(1);
    gl.vertexAttrib1f(1, 1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.faces);
    const there = columns(data.modes[mode]);
    put(buffers.vertices, there, [...PART, 1], 1, 0, () => gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_INT, 0));
    if (shown.checked) {
      gl.uniform1f(uniform("size"), 5 * ratio);
      put(buffers.points, there, [0, 0, 0, 1], 2, 0.01 * data.reach, () => {
        gl.bindBuffer(gl.ARRAY_BUFFER, buffers.weights);
        gl.enableVertexAttribArray(1);
        gl.vertexAttribPointer(1, 1, gl.FLOAT, false, 0, 0);
        gl.drawArrays(gl.POINTS, 0, points.length / 3);
        gl.disableVertexAttribArray(1);
      });
    }
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    for (const [buffer, n] of buffers.outlines)
      put(buffer, IDENTITY, [...OBSERVED, 1], 0, 0.002 * data.reach, () => gl.drawArrays(gl.LINE_LOOP, 0, n));
    gl.depthMask(false);
    for (const buffer of buffers.windows) {
      put(buffer, IDENTITY, [...WINDOW, 0.3], 0, 0, () => gl.drawArrays(gl.TRIANGLE_FAN, 0, 4));
      put(buffer, IDENTITY, [...WINDOW, 1], 0, 0, () => gl.drawArrays(gl.LINE_LOOP, 0, 4));
    }
  };

  const choose = (k) => {
    mode = (k + tabs.length) % tabs.length;
    tabs.forEach((tab, i) => {
      tab.setAttribute("aria-selected", i === mode);
      tab.tabIndex = i === mode ? 0 : -1;
    });
    canvas.setAttribute("aria-label", `the object at ${tabs[mode].textContent.trim()}`);
    draw();
  };
  const turned = (right, up) => {
    turn -= right;
    rise = Math.max(-1.5, Math.min(1.5, rise + up));
    draw();
  };

  tabs.forEach((tab, k) => tab.addEventListener("click", () => choose(k)));
  shown.addEventListener("change", draw);
  root.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    const onTab = event.target.getAttribute("role") === "tab";
    if (step && onTab && step[0]) {
      choose(mode + step[0]);
      tabs[mode].focus();
    } else if (step && !onTab && event.target === canvas) turned(0.1 * step[0], 0.1 * step[1]);
    else if (event.key >= "1" && event.key <= String(tabs.length)) choose(Number(event.key) - 1);
    else return;
    event.preventDefault();
  });
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (event.buttons) turned(0.01 * event.movementX, 0.01 * event.movementY);
  });
  canvas.addEventListener(
    "wheel",
    (event) => {
      if (document.activeElement !== canvas) return; // the page scrolls
      event.preventDefault();
      zoom = Math.max(0.3, Math.min(8, zoom * Math.exp(-0.002 * event.deltaY)));
      draw();
    },
    { passive: false },
  );
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  new ResizeObserver(draw).observe(canvas);
  choose(0);
})();
