// Moves the line between two pictures: a range input takes the mouse, a finger and the arrow keys.
document.addEventListener("DOMContentLoaded", () => {
  for (const box of document.querySelectorAll(".before-after")) {
    const line = document.createElement("input");
    Object.assign(line, { type: "range", min: 0, max: 100, value: 50 });
    line.setAttribute("aria-label", "Line between before and after");
    line.addEventListener("input", () => box.style.setProperty("--line", `${line.value}%`));
    box.append(line);
  }
});
